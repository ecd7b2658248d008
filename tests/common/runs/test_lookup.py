"""Lookup by name: shipped artifacts before files."""

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle, pretrained_folder
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs import lookup
from dreamfleet.common.runs.lookup import find_subspace


@pytest.fixture
def subspace():
    return Subspace(np.ones((2, 5), np.float32), np.zeros(2, np.float32), ("a", "b"), "ab" * 32)


@pytest.mark.parametrize(
    "path", sorted((pretrained_folder() / lookup.SUBSPACES).glob("*.npz")), ids=lambda path: path.stem
)
def test_a_shipped_subspace_fits_the_world_model_of_its_name(path):
    assert find_subspace(path.stem).bundle == find_bundle(path.stem).sha256


def test_a_subspace_is_a_shipped_one_or_a_file(subspace, tmp_path, monkeypatch):
    monkeypatch.setattr(lookup, "pretrained_folder", lambda: tmp_path / "ships")
    (tmp_path / "ships" / lookup.SUBSPACES).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=r"no subspace 'tiny': .* one that ships \(none\)"):
        find_subspace("tiny")
    subspace.save(tmp_path / "ships" / lookup.SUBSPACES / "tiny.npz", {})
    assert find_subspace("tiny").sha256 == subspace.sha256
    with pytest.raises(UsageError, match=r"no subspace 'few\.npz': .* one that ships \(tiny\), or none"):
        find_subspace("few.npz")
    subspace.save(tmp_path / "few.npz", {})
    assert find_subspace("few.npz").sha256 == subspace.sha256
    (tmp_path / "broken.npz").write_text("rubbish")
    with pytest.raises(UsageError, match=r"broken\.npz is not a subspace"):
        find_subspace("broken.npz")
