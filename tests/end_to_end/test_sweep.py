"""A sweep with real processes: it ends with a comparison, survives the loss of everything, and refuses bad input.

Tests dreamfleet/experiments/sweep/display.py, dreamfleet/experiments/sweep/runner.py and
dreamfleet/experiments/verbs/sweep.py.
"""

import json
import os
import signal
import stat
import time

import pytest

from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.experiments.sweep import runner
from tests.support import tasks
from tests.support.access import until
from tests.support.processes import DEADLINE, ROOT, call_here

FLAGS = ("--population", 4, "--episodes", 1, "--evaluate-every", 0, "--parallel", 3, "--workers", 2)


def journal(folder, name):
    with open_run(folder, name) as run:
        episodes = [[(each.seed, each.fitness) for each in run.results(0, candidate)] for candidate in range(4)]
        return run.ended, episodes, [(each.number, each.mean, each.best, each.sigma) for each in run.history()]


def start(processes, runs, *arguments):
    return processes.start("sweep", "--runs-dir", runs, *arguments)


@pytest.fixture
def common(random_bundle):
    return (*FLAGS, "--bundle", random_bundle.path, "--task", tasks.SLOW_TOY)


@pytest.mark.slow
def test_a_sweep_compares_settings_and_each_run_has_the_bits_that_it_has_alone(processes, common):
    vary = ("--vary", "seed=1..2", "sigma0=0.05,0.1")
    sweep = start(processes, processes.runs, "--run", "toys", *vary, *common, "--generations", 2, "--json")
    code, out = sweep.finish()
    assert code == 0, "".join(sweep.lines)
    answer = json.loads(out)
    assert [(each["setting"], each["runs"]) for each in answer["settings"]] == [("sigma0 0.05", 2), ("sigma0 0.1", 2)]
    assert all(each["error"] is not None for each in answer["settings"])
    assert {each["state"] for each in answer["runs"]} == {"finished"}
    assert (processes.runs / "toys.sweep" / "learning.png").stat().st_size > 1000
    coordinator = processes.coordinator(
        *common[:6], *common[10:], "--generations", 2, "--seed", 2, "--sigma0", 0.1, name="alone"
    )
    processes.worker("--task", tasks.SLOW_TOY)
    assert coordinator.finish()[0] == 0
    assert journal(processes.runs, "alone") == journal(processes.runs, "toys-seed2-sigma0-0-1")
    again = start(processes, processes.runs, "--resume", "toys", "--json")
    assert again.finish()[0] == 0
    assert json.loads(again.finish()[1])["settings"] == answer["settings"]
    runs = processes.call("runs", "list", "--runs-dir", processes.runs, "--json")[1]
    assert [each["run"] for each in json.loads(runs) if each["sweep"] != "toys"] == ["alone"]
    compared = processes.call("compare", "toys", "--runs-dir", processes.runs, "--json")[1]
    assert json.loads(compared)["settings"] == answer["settings"]
    text = processes.call("compare", "toys", "alone", "--runs-dir", processes.runs)[1]
    assert [line.split()[0] for line in text.splitlines()[1:4]] == ["toys:", "toys:", "alone"]


@pytest.mark.slow
def test_killed_with_everything_it_resumes_to_the_same_bits(processes, common, tmp_path):
    vary = ("--run", "toys", "--vary", "seed=1..3", *common, "--generations", 2)
    whole = start(processes, tmp_path / "whole", *vary)
    assert whole.finish()[0] == 0
    sweep = start(processes, processes.runs, *vary, "--parallel", 2)
    sweep.wait_for("toys-seed1: finished")
    os.kill(sweep.popen.pid, signal.SIGKILL)  # its processes end with it
    second = start(processes, processes.runs, *vary)
    assert second.finish()[0] == 2
    assert "--resume toys" in second.last_line()
    resumed = start(processes, processes.runs, "--resume", "toys", "--workers", 2)
    assert resumed.finish()[0] == 0, "".join(resumed.lines)
    assert any("toys-seed1: finished, before" in line for line in resumed.lines)
    for seed in (1, 2, 3):
        assert journal(processes.runs, f"toys-seed{seed}") == journal(tmp_path / "whole", f"toys-seed{seed}")


@pytest.mark.slow
def test_of_two_that_begin_at_once_one_goes_on_and_ctrl_c_ends_it_in_order(processes, common):
    vary = ("--run", "toys", "--vary", "seed=1..2", *common, "--generations", 10**6)
    both = [start(processes, processes.runs, *vary) for _ in range(2)]
    refused = next(each for each in _until_one_ended(both) if each.popen.poll() is not None)
    assert refused.finish()[0] == 2
    (served,) = (each for each in both if each is not refused)
    begun = [processes.runs / f"toys-seed{seed}" / JOURNAL for seed in (1, 2)]
    until(lambda: all(each.exists() for each in begun), "both runs begin")
    copy = start(processes, processes.runs, "--resume", "toys")
    assert copy.finish()[0] == 2
    assert str(processes.runs) in copy.last_line()
    served.popen.send_signal(signal.SIGINT)
    assert served.finish()[0] == 130
    assert "--resume toys" in served.last_line()
    for seed in (1, 2):
        with open_run(processes.runs, f"toys-seed{seed}") as run:
            assert run.ended is None


def _until_one_ended(started):
    deadline = time.monotonic() + DEADLINE
    while all(each.popen.poll() is None for each in started):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return started


@pytest.mark.slow
def test_a_run_that_fails_stops_no_other(processes, common, monkeypatch):
    monkeypatch.setattr(runner, "PAUSE_PATIENCE", 1.0)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    vary = ("--vary", f"task={tasks.SLOW_TOY},{tasks.RAISING}")
    flags = (*common[:-2], "--failure-limit", 0.5, "--generations", 2, "--runs-dir", processes.runs)
    assert call_here("sweep", "--run", "both", *vary, *flags)[0] == 1
    with open_run(processes.runs, f"both-task-{tasks.SLOW_TOY.lower().replace('.', '-').replace(':', '-')}") as run:
        assert run.ended == "2 generations"


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_folder_that_cannot_be_written_is_named(processes, common):
    processes.runs.mkdir(parents=True)
    processes.runs.chmod(stat.S_IRUSR | stat.S_IXUSR)
    sweep = start(processes, processes.runs, "--run", "toys", "--vary", "seed=1..2", *common, "--generations", 2)
    assert sweep.finish()[0] == 1
    assert "--runs-dir" in sweep.last_line()
