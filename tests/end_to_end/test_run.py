"""A run with a task that scores in no time: what its coordinator, workers, status and journal do.
Tests common/verbs/control.py, coordinator/service/main.py, coordinator/verbs/coordinator.py and
worker/verbs/worker.py."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.protocol.stop_kind import StopKind
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.coordinator.settings.start import latest_mean_and_sigma
from tests.support import tasks
from tests.support.processes import DEADLINE, call_here, free_port

OWN = "tests.support.optimisers:ParentsAndChildren"


@pytest.mark.slow
def test_a_worker_that_started_first_waits_fetches_the_bundle_and_leaves_when_the_run_is_over(processes, small):
    worker = processes.worker("--task", tasks.TOY, "--exit-when-done")
    worker.wait_for_event("no coordinator")
    coordinator = processes.coordinator(*small, "--task", tasks.TOY, "--generations", 3)
    worker.wait_for_event("fetched")
    assert coordinator.finish()[0] == 0
    assert worker.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        assert [each.number for each in run.history()] == [0, 1, 2]


def test_the_mean_is_evaluated_on_schedule_and_at_the_end_and_the_target_ends_the_run(processes, small):
    coordinator = processes.coordinator(
        *small, "--task", tasks.TOY, "--population", 8, "--sigma0", 0.2, "--evaluate-every", 5,
        "--evaluation-episodes", 3, "--generations", 400, "--target", -4,
    )  # fmt: skip
    processes.worker("--task", tasks.TOY)
    assert coordinator.finish()[0] == 0
    with open_run(processes.runs, "test") as run:
        evaluations = run.evaluations()
        assert [each.generation % 5 for each in evaluations[:-1]] == [4] * (len(evaluations) - 1)
        assert max(each.mean for each in evaluations) >= -4
        assert run.stop_kind is StopKind.TARGET
        seeds = [each.seed for each in run.results(4, 0, "evaluate")]
    assert seeds[:3] == [20000, 20001, 20002], "those that confirm come later"


@pytest.mark.slow
def test_status_is_json_that_zenoh_cli_reads_too(processes, small):
    coordinator = processes.coordinator(*small)
    processes.worker("--task", tasks.SLOW_TOY)
    coordinator.wait_for_event("generation", number=1)
    ours = processes.status()
    assert (ours["schema"], ours["run"], ours["state"], ours["slots"]) == (2, "test", "running", 1)
    assert ours["worker_list"][0]["state"] == "present"
    tool = Path(sys.executable).parent / "zenoh"
    command = [tool, "--mode", "client", "--connect", processes.endpoint, "get", "-s", "dreamfleet/v2/test/status"]
    done = subprocess.run([*command, "--decoder", "json"], capture_output=True, text=True, timeout=DEADLINE, check=True)
    theirs = done.stdout[done.stdout.index("{") :]
    assert json.JSONDecoder().raw_decode(theirs)[0]["run_uid"] == ours["run_uid"]
    assert processes.call("status", "--connect", processes.endpoint)[0] == 0


def test_a_second_coordinator_of_a_live_run_and_a_foreign_one_of_its_name_are_refused(processes, small, tmp_path):
    processes.coordinator(*small)
    elsewhere = ("--listen", f"tcp/127.0.0.1:{free_port()}")
    assert call_here("coordinator", "--resume", "test", "--runs-dir", processes.runs, *elsewhere)[0] != 0
    foreign = ("--run", "test", "--runs-dir", tmp_path / "elsewhere", "--connect", processes.endpoint)
    assert call_here("coordinator", *foreign, *small)[0] != 0
    assert not (tmp_path / "elsewhere").exists(), "a run that cannot be served is not created"


@pytest.mark.parametrize("flag", ["--listen", "--metrics-port"])
def test_a_new_run_whose_port_is_taken_is_not_created(processes, small, flag):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = f"127.0.0.1:{other.getsockname()[1]}"
        where = ("--listen", f"tcp/{taken}") if flag == "--listen" else ("--listen", processes.endpoint, flag, taken)
        code, _, err = call_here("coordinator", "--run", "test", "--runs-dir", processes.runs, *where, *small)
    assert (code, taken in err, flag in err) == (1, True, True), err
    assert not processes.runs.exists()


@pytest.mark.slow
def test_pause_resume_and_drain_from_the_command_line(processes, small):
    coordinator = processes.coordinator(*small)
    processes.worker("--task", tasks.SLOW_TOY)
    coordinator.wait_for_event("generation", number=0)

    def say(*words):
        code, out, err = processes.call(*words, "--connect", processes.endpoint)
        assert code == 0, err
        return out

    assert json.loads(say("pause", "--json")) == {"run": "test", "asked": "pause", "accepted": True}
    assert processes.status()["state"] == "paused"
    assert json.loads(say("resume", "test", "--json"))["accepted"]
    coordinator.wait_for_event("generation", times=2)
    drained = json.loads(say("drain", "test", "--json"))
    assert coordinator.finish()[0] == 130
    assert coordinator.lines[-1].rstrip().endswith(drained["continue"])
    assert f"--resume test --runs-dir {processes.runs}" in drained["continue"]
    with open_run(processes.runs, "test") as run:
        assert run.ended is None
        number = len(run.history())
        assert len([each for i in range(4) for each in run.results(number, i)]) <= 4


@pytest.mark.slow
def test_a_fork_begins_where_its_run_was_and_may_change_what_is_frozen(processes, small):
    toy = (*small, "--task", tasks.TOY)
    first = processes.coordinator(*toy, "--generations", 3)
    processes.worker("--task", tasks.TOY, "--exit-when-done")
    assert first.finish()[0] == 0
    own = ("--optimiser", OWN, "--optimiser-options", "parents=1")
    fork = processes.fork("test", "--population", 6, *own, "--generations", 1)
    processes.worker("--task", tasks.TOY, "--run", "test-fork")
    assert fork.finish()[0] == 0
    with open_run(processes.runs, "test") as one, open_run(processes.runs, "test-fork") as other:
        before, sigma = latest_mean_and_sigma(one)
        start = other.history()[0]
        assert other.settings.population == 6
        assert (other.settings.optimiser, other.settings.optimiser_options) == (OWN, ("parents=1",))
        assert start.sigma == pytest.approx(sigma)
        population = np.stack([other.candidate(0, i) for i in range(6)])
        assert np.abs(population - before).max() < 6 * sigma
        assert np.abs(before).max() > 0
    from_controller = processes.coordinator(*toy, "--init", "test", "--generations", 1, name="third")
    processes.worker("--task", tasks.TOY, "--run", "third")
    assert from_controller.finish()[0] == 0
