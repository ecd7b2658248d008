"""A sweep with real processes: it ends with a comparison, survives the loss of everything, and refuses bad input.

Tests dreamfleet/experiments/sweep/display.py, dreamfleet/experiments/sweep/runner.py and
dreamfleet/experiments/verbs/sweep.py.
"""

import json
import os
import signal
import stat

import pytest

from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.coordinator.run.recall import bar_stored
from dreamfleet.experiments.sweep import runner
from tests.support import tasks
from tests.support.processes import ROOT, call_here, until
from tests.support.same_bits import evolve

FLEET = ("--parallel", 3, "--workers", 2)


def journal(folder, name):
    with open_run(folder, name) as run:
        episodes = [[(each.seed, each.fitness) for each in run.results(0, candidate)] for candidate in range(4)]
        return run.ended, episodes, [(each.number, each.mean, each.best, each.sigma) for each in run.history()]


@pytest.fixture
def sweep(processes, small):
    """Starts one of short runs."""
    return lambda *words: processes.start(
        "sweep", "--run", "toys", *small, *FLEET, *words, "--runs-dir", processes.runs
    )


@pytest.mark.slow
def test_a_sweep_compares_settings_and_each_run_has_the_bits_that_it_has_alone(processes, small, sweep):
    made = sweep("--vary", "seed=1..2", "sigma0=0.05,0.1", "--generations", 2, "--json")
    code, out = made.finish()
    assert code == 0, "".join(made.lines)
    answer = json.loads(out)
    assert [(each["setting"], each["runs"]) for each in answer["settings"]] == [("sigma0 0.05", 2), ("sigma0 0.1", 2)]
    assert all(each["error"] is not None for each in answer["settings"])
    assert {each["state"] for each in answer["runs"]} == {"finished"}
    assert (processes.runs / "toys.sweep" / "learning.png").stat().st_size > 1000
    evolve(processes, "alone", 1, *small, "--generations", 2, "--seed", 2, "--sigma0", 0.1, task=tasks.SLOW_TOY)
    assert journal(processes.runs, "alone") == journal(processes.runs, "toys-seed2-sigma0-0-1")
    runs = ("--runs-dir", processes.runs)
    assert json.loads(processes.printed("sweep", "--resume", "toys", *runs, "--json"))["settings"] == answer["settings"]
    listed = json.loads(call_here("runs", "list", *runs, "--json")[1])
    assert [each["run"] for each in listed if each["sweep"] != "toys"] == ["alone"]
    assert json.loads(call_here("compare", "toys", *runs, "--json")[1])["settings"] == answer["settings"]
    text = call_here("compare", "toys", "alone", *runs)[1]
    assert [line.split()[0] for line in text.splitlines()[1:4]] == ["toys:", "toys:", "alone"]


@pytest.mark.slow
def test_killed_with_everything_it_resumes_and_finishes_each_run(processes, sweep):
    vary = ("--vary", "seed=1..3", "--generations", 2)
    killed = sweep(*vary, "--parallel", 2)
    killed.wait_for("toys-seed1: finished")
    os.kill(killed.popen.pid, signal.SIGKILL)  # its processes end with it
    second = sweep(*vary)
    assert second.finish()[0] == 2
    assert "--resume toys" in second.last_line()
    resumed = processes.start("sweep", "--resume", "toys", "--workers", 2, "--runs-dir", processes.runs)
    assert resumed.finish()[0] == 0, "".join(resumed.lines)
    assert any("toys-seed1: finished, before" in line for line in resumed.lines)
    assert [journal(processes.runs, f"toys-seed{seed}")[0] for seed in (1, 2, 3)] == ["2 generations"] * 3


@pytest.mark.slow
def test_of_two_that_begin_at_once_one_goes_on_and_ctrl_c_ends_it_in_order(processes, sweep):
    both = [sweep("--vary", "seed=1..2", "--generations", 10**6) for _ in range(2)]
    until(lambda: any(each.popen.poll() is not None for each in both))
    refused = next(each for each in both if each.popen.poll() is not None)
    assert refused.finish()[0] == 2
    (served,) = (each for each in both if each is not refused)
    begun = [processes.runs / f"toys-seed{seed}" / JOURNAL for seed in (1, 2)]
    until(lambda: all(each.exists() for each in begun), "both journals")
    copy = processes.start("sweep", "--resume", "toys", "--runs-dir", processes.runs)
    assert copy.finish()[0] == 2
    assert str(processes.runs) in copy.last_line()
    assert served.stop(signal.SIGINT)[0] == 130
    assert "--resume toys" in served.last_line()
    for seed in (1, 2):
        with open_run(processes.runs, f"toys-seed{seed}") as run:
            assert run.ended is None


@pytest.mark.slow
def test_a_run_that_fails_stops_no_other(processes, small, monkeypatch):
    monkeypatch.setattr(runner, "PAUSE_TIMEOUT", 1.0)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    vary = ("--vary", f"task={tasks.SLOW_TOY},{tasks.RAISING}")
    flags = (*small[:-2], *FLEET, "--failure-limit", 0.5, "--generations", 2, "--runs-dir", processes.runs)
    assert call_here("sweep", "--run", "both", *vary, *flags)[0] == 1
    with open_run(processes.runs, f"both-task-{tasks.SLOW_TOY.lower().replace('.', '-').replace(':', '-')}") as run:
        assert run.ended == "2 generations"


@pytest.mark.slow
def test_a_run_from_which_its_own_workers_are_barred_fails_and_says_how_to_let_them_in(processes, sweep, monkeypatch):
    monkeypatch.setattr(runner, "PAUSE_TIMEOUT", 1.0)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    assert sweep("--vary", "seed=1..2", "--generations", 1, "--workers", 1).finish()[0] == 0
    folder, words = processes.runs / "toys-seed2", ("--resume", "toys", "--workers", 1, "--runs-dir", processes.runs)
    bar_stored(folder, "core-0", is_barred=True)
    code, _, text = call_here("sweep", *words)
    assert code == 1
    assert f"bar core-0 toys-seed2 --no-longer --runs-dir {processes.runs}" in text
    bar_stored(folder, "core-0", is_barred=False)
    assert call_here("sweep", *words)[0] == 0


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_folder_that_cannot_be_written_is_named(processes, sweep):
    processes.runs.mkdir(parents=True)
    processes.runs.chmod(stat.S_IRUSR | stat.S_IXUSR)
    refused = sweep("--vary", "seed=1..2", "--generations", 2)
    assert refused.finish()[0] == 1
    assert "--runs-dir" in refused.last_line()
