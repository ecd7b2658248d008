"""gymnasium's own environments and Take Cover on a fleet, without a bundle: learnt to the same bits by any.

Tests coordinator/addons/environment_check.py, worker/worlds/gym/task.py and worker/worlds/takecover/task.py.
"""

import json

import pytest

from tests.support.environments import ODD
from tests.support.processes import call_here, printed
from tests.support.same_bits import check_replay, evolve
from tests.support.tables import cells

NORMAL = ("--normalise", "--population", 32, "--episodes", 4, "--evaluation-episodes", 16)
LEARNT = {  # settings, generations, and the mean over 50 unseen seeds that is to be passed
    "lander": (("--task", "gym:LunarLander-v3", *NORMAL, "--sigma0", 0.3), 80, 200),
    "continuous": (
        ("--task", "gym:LunarLander-v3", "--environment", "continuous=true", *NORMAL, "--sigma0", 0.3), 60, 200,
    ),
    "pendulum": (
        ("--task", "gym:Pendulum-v1", *NORMAL, "--controller", "hidden", "--hidden-units", 16, "--sigma0", 1.0), 120,
        -250,
    ),
}  # fmt: skip


@pytest.mark.slow
def test_a_run_without_a_bundle_evolves_and_the_verbs_take_it(processes):
    settings = ("--task", "gym:CartPole-v1", "--population", 6, "--episodes", 2, "--generations", 3,
                "--evaluate-every", 2, "--evaluation-episodes", 3)  # fmt: skip
    evolve(processes, "one", 1, *settings, task=settings[1])
    assert not (processes.runs / "one" / "bundle.zip").exists()

    check_replay(processes, "one", "2/3", 2)
    of_it = ("--controller", "one", "--runs-dir", processes.runs)
    judged = json.loads(printed("evaluate", *of_it, "--episodes", 3, "--json"))
    assert judged["task"] == "gym:CartPole-v1"
    video = processes.folder / "drive.mp4"
    printed("record", *of_it, "--out", video)
    assert video.stat().st_size > 1000
    printed("inspect", "one", *of_it[2:], "--out", processes.folder / "page")
    forked = processes.fork("one", "--run", "fork", "--generations", 1)
    processes.worker("--run", "fork", "--exit-when-done")
    assert forked.finish()[0] == 0


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", LEARNT)
def test_it_is_learnt_from_zero_on_two_workers_and_one_gives_the_same_bits(processes, name):
    settings, generations, wanted = LEARNT[name]
    settings = (*settings, "--generations", generations, "--evaluate-every", 10)
    two = evolve(processes, name, 2, *settings, task=settings[1])
    judged = ("evaluate", "--controller", name, "--runs-dir", processes.runs, "--episodes", 50, "--json")
    answer = json.loads(printed(*judged))
    print(f"{name}: {answer['mean']:.1f}, standard error {answer['std'] / 50**0.5:.1f}, 50 unseen seeds")  # noqa: T201
    assert answer["mean"] > wanted
    assert evolve(processes, "alone", 1, *settings, task=settings[1]) == two


@pytest.mark.slow
def test_what_a_run_is_begun_in_is_tried_first(processes):
    odd = ("--run", "odd", "--runs-dir", processes.runs, "--task", ODD, "--environment")
    processes.refused(ODD, "coordinator", *odd, "fault=old step")
    processes.refused("--strict", "coordinator", *odd, "fault=noise", "--strict")
    assert not (processes.runs / "odd").exists()
    assert json.loads(printed("tasks", ODD, "--environment", "fault=noise", "--json"))["varies"]
    code, out, _ = call_here("tasks", ODD, "--environment", "fault=crash")
    assert (code, "SIGSEGV" in out) == (1, True)
    printed("tasks", "car-racing")
    rows = [cells(line) for line in processes.printed("doctor", "--task", ODD).splitlines()]
    assert f"task {ODD}" in [row[1] for row in rows if len(row) > 1]


@pytest.mark.slow
def test_a_run_in_an_environment_that_is_not_deterministic_promises_no_bits(processes):
    coordinator = processes.coordinator(
        "--task", ODD, "--environment", "fault=noise", "--population", 4, "--generations", 2, "--evaluate-every", 0
    )
    assert any(line.facts.get("level") == "warning" and ODD in line for line in coordinator.lines)
    processes.worker("--task", ODD, "--exit-when-done")
    assert coordinator.finish()[0] == 0
    assert "100.0%" in processes.printed("runs", "show", "test", "--runs-dir", processes.runs)
    replay = ("verify", "candidate", "test", "--runs-dir", processes.runs, "--candidate", "1/0")
    code, out, _err = processes.call(*replay)
    assert (code, "DIFFERS" in out) == (1, False), "another fitness is no surprise there"
    assert "1000" in processes.printed(*replay, "--tolerance", 1000)


@pytest.mark.slow
@pytest.mark.needs_doom
def test_a_run_of_take_cover_evolves_is_replayed_to_the_same_bits_and_the_verbs_take_it(processes):
    settings = ("--task", "takecover", "--bundle", "none", "--horizon", 525, "--population", 6, "--episodes", 2,
                "--generations", 2, "--evaluate-every", 1, "--evaluation-episodes", 4)  # fmt: skip
    evolve(processes, "one", 2, *settings)
    check_replay(processes, "one", "1/3", 2, call=processes.call)
    of_it = ("--controller", "one", "--runs-dir", processes.runs)
    assert " 750" in processes.printed("evaluate", *of_it, "--episodes", 3)
    for verb, more in (("record", ("--steps", 5)), ("live", ("--seconds", 1))):
        video = processes.folder / f"{verb}.mp4"
        processes.printed(verb, *of_it, *more, "--out", video)
        assert video.exists()
