"""Runs whose controllers drive otherwise: each option is replayed to the bit, and every verb knows of it.
Tests common/artifacts/car_racing_variants.py, common/artifacts/driving.py, worker/worldmodel/choice_memory.py and
worker/worlds/car_racing/task.py."""

import json

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.runs.run_folder import open_run
from tests.support import checkpoint_files
from tests.support.processes import printed
from tests.support.same_bits import check_replay, evolve

HORIZON = 30
RUNS = {
    "pedals": (("--variant", "pedals=one", "pedal_shift=0.25"), (288, 2)),
    "halves": (("--preset", "article"), (288, 3)),
    "discrete": (("--variant", "actions=discrete"), (288, 5)),
    "time": (("--variant", "time_cost=0.5"), (288, 3)),
    "dreamt": (("--task", "dream", "--variant", "pedals=one", "decide_every=3", "feedback=last"), (292, 2)),
}


@pytest.fixture
def driven(small):
    return (*small, "--task", "car-racing", "--horizon", HORIZON, "--generations", 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [pytest.param(each, marks=() if each == "dreamt" else pytest.mark.long) for each in RUNS]
)
def test_a_run_evolves_and_is_replayed_to_the_same_bits(processes, driven, kind):
    flags, shape = RUNS[kind]
    evolve(processes, "one", 1, *driven, *flags)
    with open_run(processes.runs, "one") as run:
        assert (run.settings.controller.features, run.settings.controller.actions) == shape
        assert {each.steps for each in run.results(1, 2)} == {HORIZON}
        controller = Controller.load(run.controller_path)
        assert controller.options == run.spec.options != ""
    check_replay(processes, "one", "1/2", 1)


@pytest.mark.slow
def test_every_verb_drives_as_the_run_does(processes, driven):
    variant = ("--variant", "pedals=one", "decide_every=3", "feedback=last")
    evolve(processes, "one", 1, *driven, *variant, "--collect-every", 1, "--collect-episodes", 1)
    runs = ("--runs-dir", processes.runs)
    check_replay(processes, "one", "1/2", 1)
    assert '"decide_every": 3' in printed("runs", "show", "one", *runs)
    printed("evaluate", "--controller", "one", *runs, "--episodes", 2, "--jobs", 2)
    video = processes.folder / "drive.mp4"
    processes.printed("record", "--controller", "one", *runs, "--out", video, "--steps", 8)
    assert video.stat().st_size > 1000
    processes.printed("inspect", "one", *runs, "--out", processes.folder / "page", "--steps", 20)
    processes.printed("collect", "--data", processes.folder / "data", "--from-run", "one", *runs)
    for path in (processes.folder / "data" / "episodes").iterdir():
        with np.load(path) as drive:
            steps = drive["action"][: HORIZON // 3 * 3].reshape(-1, 3, 3)
            assert (steps == steps[:, :1]).all()
            assert not (drive["action"][:, 1] * drive["action"][:, 2]).any(), "nobody brakes on the gas"


@pytest.mark.slow
def test_a_run_goes_on_from_a_controller_of_ctallec(processes, tmp_path):
    imported = tmp_path / "exp_dir"
    checkpoint_files.write_checkpoints(imported, checkpoint_files.random_weights())
    world, controller = tmp_path / "world.zip", tmp_path / "controller.npz"
    for command in ((imported, "--out", world), (imported / "ctrl", "--bundle", world, "--out", controller)):
        processes.printed("import", *command)
    few = ("--population", 4, "--episodes", 1, "--horizon", 5, "--evaluate-every", 0, "--generations", 1)
    evolve(processes, "test", 1, "--bundle", world, "--init", controller, *few)
    with open_run(processes.runs, "test") as run:
        evolved = Controller.load(run.controller_path)
    assert evolved.variant.actions == "linear"
    check_replay(processes, "test", "0/1", 1)
    judged = processes.printed("evaluate", "--controller", controller, "--bundle", world, "--episodes", 1, "--json")
    assert isinstance(json.loads(judged)["mean"], float), judged
