import json
import re
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle, pretrained_folder
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.errors import ConnectionFailedError, ControllerError, UsageError
from dreamfleet.common.runs import lookup
from dreamfleet.common.runs.lookup import find_controller, find_subspace, naming_the_stored_run
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.coordinator.addons.runs.stored_run import open_run
from dreamfleet.coordinator.settings.config import RunConfig
from dreamfleet.coordinator.settings.freezing import freeze
from dreamfleet.coordinator.storage.journal import Journal
from tests.support.journals import confirm
from tests.support.processes import call_here, printed


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


def test_a_controller_that_lags_behind_the_journal_is_the_one_that_the_journal_reports(runs):
    written = Controller.load(runs / "reality" / CONTROLLER)
    old = replace(written, parameters=written.parameters + 1, provenance=written.provenance | {"generation": 0})
    old.save(runs / "reality" / CONTROLLER)
    for name, folder in (("reality", runs), (str(runs / "reality"), runs / "elsewhere")):
        found, _ = find_controller(name, folder)
        assert (found.sha256, found.provenance | written.provenance) == (written.sha256, found.provenance)
    with open_run("reality", runs) as run:
        assert run.controller().sha256 == written.sha256
    assert json.loads(printed("runs", "receipt", "reality", "--json"))["controller"] == written.sha256
    printed("runs", "backup", "reality", "--to", runs / "safe")
    assert Controller.load(runs / "safe" / "reality" / CONTROLLER).sha256 == written.sha256


def test_a_confirmed_mean_goes_before_the_best_evaluated_one(runs):
    with open_run("reality", runs) as run:
        generation, closed = min(each.generation for each in run.evaluations()), len(run.history())
        vector = run.evaluated_mean(generation)
    confirm(runs / "reality", generation, 4, 2.5, 0.5, closed)
    found, _ = find_controller("reality", runs)
    assert (found.parameters == vector).all()
    assert [found.provenance[each] for each in ("generation", "validation_mean", "confirmed")] == [
        generation,
        2.5,
        True,
    ]


def test_another_runs_controller_is_refused(runs):
    shutil.copyfile(runs / "hidden" / CONTROLLER, runs / "reality" / CONTROLLER)
    with pytest.raises(ControllerError, match="reality"):
        find_controller("reality", runs)
    assert call_here("runs", "receipt", "reality")[0] == 1
    printed("runs", "backup", "reality", "--to", runs / "safe")
    with pytest.raises(ControllerError, match="reality"):
        find_controller("reality", runs / "safe")
