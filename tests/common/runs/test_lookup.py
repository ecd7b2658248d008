import re
import shlex

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle, pretrained_folder
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import ConnectionFailedError, UsageError
from dreamfleet.common.runs import lookup
from dreamfleet.common.runs.lookup import find_subspace, naming_the_stored_run
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.storage.journal import Journal


def test_a_subspace_is_a_shipped_one_of_a_shipped_world_model_or_a_file(tmp_path, monkeypatch):
    for path in (pretrained_folder() / lookup.SUBSPACES).glob("*.npz"):
        owner = find_bundle("tiny" if path.stem == "real" else path.stem)
        assert find_subspace(path.stem).bundle == owner.sha256
    subspace = Subspace(np.ones((2, 5), np.float32), np.zeros(2, np.float32), ("a", "b"), "ab" * 32)
    monkeypatch.setattr(lookup, "pretrained_folder", lambda: tmp_path / "ships")
    (tmp_path / "ships" / lookup.SUBSPACES).mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match=r"'tiny'.* .?none"):
        find_subspace("tiny")
    subspace.save(tmp_path / "ships" / lookup.SUBSPACES / "tiny.npz", {})
    assert find_subspace("tiny").sha256 == subspace.sha256
    with pytest.raises(UsageError, match=r"'few\.npz'.* .?tiny"):
        find_subspace("few.npz")
    subspace.save(tmp_path / "few.npz", {})
    assert find_subspace("few.npz").sha256 == subspace.sha256
    (tmp_path / "broken.npz").write_text("rubbish")
    with pytest.raises(UsageError, match=r"broken\.npz"):
        find_subspace("broken.npz")


def test_where_no_coordinator_answers_the_stored_run_is_named(tmp_path, random_bundle):
    def refused(name):
        with pytest.raises(ConnectionFailedError) as caught, naming_the_stored_run(tmp_path, name):
            raise ConnectionFailedError("no one answers")
        return str(caught.value)

    assert refused("night") == refused(None) == "no one answers"
    (tmp_path / "night").mkdir()
    journal = Journal.create(tmp_path / "night", freeze(RunConfig(), random_bundle), random_bundle.path)
    assert re.search("night.* coordinator --resume night", refused("night"))
    journal.set_fact("ended", "3 generations")
    journal.commit()
    journal.close()
    assert re.search("night .*3 generations", refused("night"))
    assert shlex.split(refused(None).split("`")[1])[1:] == ["runs", "list", "--runs-dir", str(tmp_path)]
