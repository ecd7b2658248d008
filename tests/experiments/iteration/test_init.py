"""What an iteration may begin with. Tests phases.py."""

import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.experiments.iteration.phases import find_init
from tests.support.variants import controller_of


def test_no_training_goes_on_from_a_rounded_world_model(tmp_path):
    controller_of(find_bundle("tiny-int8")).save(tmp_path / "own.npz")
    whole = find_bundle("tiny").sha256[:12]
    with pytest.raises(UsageError, match=rf"own\.npz .* tiny .*{whole}"):
        find_init(str(tmp_path / "own.npz"), tmp_path)
