"""gymnasium's own environments and Take Cover on a fleet, without a bundle: learnt to the same bits by any."""

import json

import pytest

from tests.support.environments import ODD
from tests.support.processes import call_here
from tests.support.same_bits import evolve
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

    def call(*words):
        code, out, err = call_here(*words, "--runs-dir", processes.runs)
        assert code == 0, err
        return out

    assert call("verify", "candidate", "one", "--candidate", "2/3").count("same bits") == 2
    judged = json.loads(call("evaluate", "--controller", "one", "--episodes", 3, "--json"))
    assert judged["task"] == "gym:CartPole-v1"
    video = processes.folder / "drive.mp4"
    call("record", "--controller", "one", "--out", video)
    assert video.stat().st_size > 1000
    call("inspect", "one", "--out", processes.folder / "page")
    forked = processes.fork("one", "--run", "fork", "--generations", 1)
    processes.worker("--run", "fork", "--exit-when-done")
    assert forked.finish()[0] == 0


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (("--task", "gym:Nothing-v0"), "'Nothing-v0'"),
        (("--task", "CartPole-v1"), "'CartPole-v1'"),
        (("--task", "gym:CartPole-v1", "--environment", "wings"), "wings"),
        (("--task", "gym:CartPole-v1", "--environment", "wings=2"), "wings"),
        (("--task", "gym:CartPole-v1", "--temperature", "1.5"), "--temperature"),
        (("--task", "gym:CartPole-v1", "--task-options", "[1]"), "--task-options"),
        (("--task", "car-racing", "--bundle", "none"), "car-racing"),
        (("--normalise",), "--normalise"),
    ],
)
def test_settings_that_make_no_run_are_refused(tmp_path, settings, says):
    code, _, err = call_here("coordinator", "--run", "bad", "--runs-dir", tmp_path, *settings)
    assert code in (1, 2)
    assert says in err
    assert "Traceback" not in err
    assert not (tmp_path / "bad" / "journal.sqlite").exists()


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", LEARNT)
def test_it_is_learnt_from_zero_on_two_workers_and_one_gives_the_same_bits(processes, name):
    settings, generations, wanted = LEARNT[name]
    settings = (*settings, "--generations", generations, "--evaluate-every", 10)
    two = evolve(processes, name, 2, *settings, task=settings[1])
    judged = ("evaluate", "--controller", name, "--runs-dir", processes.runs, "--episodes", 50, "--json")
    code, out, err = call_here(*judged)
    assert code == 0, err
    answer = json.loads(out)
    print(f"{name}: {answer['mean']:.1f}, standard error {answer['std'] / 50**0.5:.1f}, 50 unseen seeds")  # noqa: T201
    assert answer["mean"] > wanted
    assert evolve(processes, "alone", 1, *settings, task=settings[1]) == two


@pytest.mark.slow
def test_what_a_run_is_begun_in_is_tried_first(processes):
    odd = ("--run", "odd", "--runs-dir", processes.runs, "--task", ODD, "--environment")
    code, _, err = processes.call("coordinator", *odd, "fault=old step")
    assert code == 2
    assert ODD in err.splitlines()[-1]
    code, _, err = processes.call("coordinator", *odd, "fault=noise", "--strict")
    assert code == 2
    assert "--strict" in err
    assert not (processes.runs / "odd").exists()
    code, out, _ = call_here("tasks", ODD, "--environment", "fault=noise", "--json")
    assert (code, json.loads(out)["varies"][:13]) == (0, "equal actions")
    code, out, _ = call_here("tasks", ODD, "--environment", "fault=crash")
    assert (code, "SIGSEGV" in out) == (1, True)
    assert call_here("tasks", "car-racing")[0] == 0
    code, out, _ = processes.call("doctor", "--task", ODD)
    assert code == 0
    assert f"task {ODD}" in [cells(line)[1] for line in out.splitlines() if len(cells(line)) > 1]


@pytest.mark.slow
def test_a_run_in_an_environment_that_is_not_deterministic_promises_no_bits(processes):
    coordinator = processes.coordinator(
        "--task", ODD, "--environment", "fault=noise", "--population", 4, "--generations", 2, "--evaluate-every", 0
    )
    assert any(line.facts.get("level") == "warning" and ODD in line for line in coordinator.lines)
    processes.worker("--task", ODD, "--exit-when-done")
    assert coordinator.finish()[0] == 0
    code, out, err = processes.call("runs", "show", "test", "--runs-dir", processes.runs)
    assert (code, "100.0%" in out) == (0, True), err
    replay = ("verify", "candidate", "test", "--runs-dir", processes.runs, "--candidate", "1/0")
    code, out, err = processes.call(*replay)
    assert (code, "DIFFERS" in out) == (1, False), "another fitness is no surprise there"
    code, out, err = processes.call(*replay, "--tolerance", 1000)
    assert (code, "1000" in out) == (0, True), err


@pytest.mark.slow
@pytest.mark.needs_doom
def test_a_run_of_take_cover_evolves_is_replayed_to_the_same_bits_and_the_verbs_take_it(processes):
    settings = ("--task", "takecover", "--bundle", "none", "--horizon", 525, "--population", 6, "--episodes", 2,
                "--generations", 2, "--evaluate-every", 1, "--evaluation-episodes", 4)  # fmt: skip
    evolve(processes, "one", 2, *settings)
    runs = ("--runs-dir", processes.runs)
    code, out, err = processes.call("verify", "candidate", "one", *runs, "--candidate", "1/3")
    assert (code, out.count("same bits")) == (0, 2), err
    code, out, err = processes.call("evaluate", "--controller", "one", *runs, "--episodes", 3)
    assert (code, " 750" in out) == (0, True), err
    for verb, more in (("record", ("--steps", 5)), ("live", ("--seconds", 1))):
        video = processes.folder / f"{verb}.mp4"
        code, out, err = processes.call(verb, "--controller", "one", *runs, *more, "--out", video)
        assert (code, video.exists()) == (0, True), err
