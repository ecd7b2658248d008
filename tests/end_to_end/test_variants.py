"""Runs whose controllers drive otherwise: each option is replayed to the bit, and every verb knows of it."""

import json

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.common.runs.run_folder import open_run
from tests.support.processes import call_here

POPULATION, GENERATIONS, HORIZON = 4, 2, 30
RUNS = {
    "pedals": (("--variant", "pedals=one", "pedal_shift=0.25"), (288, 2)),
    "halves": (("--preset", "article"), (288, 3)),
    "discrete": (("--variant", "actions=discrete"), (288, 5)),
    "held": (("--variant", "decide_every=4"), (288, 3)),
    "feedback": (("--variant", "feedback=last"), (294, 3)),
    "time": (("--variant", "time_cost=0.5"), (288, 3)),
    "dreamt": (("--task", "dream", "--variant", "pedals=one", "decide_every=3", "feedback=last"), (292, 2)),
}
OFTEN = ("pedals", "feedback", "dreamt")


@pytest.fixture
def evolve(processes, random_bundle):
    def run(name, *flags):
        coordinator = processes.coordinator(
            "--bundle", random_bundle.path, "--population", POPULATION, "--episodes", 1, "--horizon", HORIZON,
            "--evaluate-every", 0, "--generations", GENERATIONS, *flags, name=name,
        )  # fmt: skip
        worker = processes.worker("--run", name)
        assert coordinator.finish()[0] == 0, "".join(coordinator.lines)
        worker.end()

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", [*OFTEN, *(pytest.param(each, marks=pytest.mark.long) for each in RUNS if each not in OFTEN)]
)
def test_a_run_evolves_and_is_replayed_to_the_same_bits(processes, evolve, kind):
    flags, shape = RUNS[kind]
    evolve("one", *flags)
    with open_run(processes.runs, "one") as run:
        assert (run.settings.controller.features, run.settings.controller.actions) == shape
        assert {each.steps for each in run.results(1, 2)} == {HORIZON}
        controller = Controller.load(run.controller_path)
        assert controller.options == run.spec.options != ""
    code, out, err = call_here("verify", "candidate", "one", "--runs-dir", processes.runs, "--candidate", "1/2")
    assert (code, out.count("same bits")) == (0, 1), err


@pytest.mark.slow
def test_every_verb_drives_as_the_run_does(processes, random_bundle, evolve):
    evolve("one", "--variant", "pedals=one", "decide_every=3", "feedback=last", "--collect-every", 1,
           "--collect-episodes", 1)  # fmt: skip
    runs = ("--runs-dir", processes.runs)
    code, out, err = call_here("runs", "show", "one", *runs)
    assert '"decide_every": 3' in out, err
    drives = {}
    for jobs in (1, 2):
        code, out, err = call_here("evaluate", "--controller", "one", *runs, "--episodes", 2, "--jobs", jobs, "--json")
        assert code == 0, err
        drives[jobs] = json.loads(out)["scores"]
    assert drives[1] == drives[2]
    video = processes.folder / "drive.mp4"
    code, out, err = processes.call("record", "--controller", "one", *runs, "--out", video, "--steps", 8)
    assert code == 0, err
    assert video.stat().st_size > 1000
    code, out, err = processes.call("inspect", "one", *runs, "--out", processes.folder / "page", "--steps", 20)
    assert code == 0, err
    code, out, err = processes.call("collect", "--data", processes.folder / "data", "--from-run", "one", *runs)
    assert code == 0, err
    for path in (processes.folder / "data" / "episodes").iterdir():
        with np.load(path) as drive:
            steps = drive["action"][: HORIZON // 3 * 3].reshape(-1, 3, 3)
            assert (steps == steps[:, :1]).all()
            assert not (drive["action"][:, 1] * drive["action"][:, 2]).any(), "nobody brakes on the gas"


@pytest.mark.slow
def test_a_run_begins_from_a_controller_that_drives_alike_alone(processes, random_bundle, evolve):
    evolve("one", "--variant", "pedals=one")
    runs = ("--runs-dir", processes.runs)
    two = ("coordinator", "--run", "two")
    for flags, datum in (
        ((*two, "--init", "one", "--variant", "decide_every=4"), '{"pedals": "one"}'),
        ((*two, "--init", "tiny", "--bundle", "tiny", "--variant", "pedals=one"), "--variant"),
        (("coordinator", "--from", "one", "--variant", "feedback=last"), "--variant"),
        ((*two, "--variant", "pedal=one"), "actions, "),
        ((*two, "--task", "gym:CartPole-v1", "--variant", "pedals=one"), "--variant"),
    ):
        bundle = ("--bundle", random_bundle.path) if {"--init", "one"} <= set(flags) else ()
        code, _, err = call_here(*flags, *bundle, *runs)
        assert code in (1, 2)
        assert datum in err
        assert "Traceback" not in err
    for name, begun in (
        ("brought", ("coordinator", "--run", "brought", "--init", "one", "--bundle", random_bundle.path)),
        ("paying", ("coordinator", "--run", "paying", "--init", "one", "--bundle", random_bundle.path,
                    "--variant", "pedals=one", "time_cost=0.5")),
        ("forked", ("coordinator", "--from", "one", "--run", "forked")),
    ):  # fmt: skip
        settings = ("--population", 4, "--episodes", 1, "--horizon", 5, "--generations", 1, "--evaluate-every", 0)
        coordinator = processes.start(*begun, *runs, "--listen", processes.endpoint, "--beat", 0.2, *settings)
        processes.worker("--run", name, "--exit-when-done")
        assert coordinator.finish()[0] == 0, "".join(coordinator.lines)
        controller, _ = find_controller(name, processes.runs)
        assert (controller.variant.pedals, controller.variant.time_cost) == ("one", 0.5 if name == "paying" else 0)
