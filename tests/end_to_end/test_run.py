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


@pytest.fixture
def settings(random_bundle):
    return ("--bundle", random_bundle.path, "--population", 4, "--episodes", 2, "--evaluate-every", 0)


def history(processes, name="test"):
    with open_run(processes.runs, name) as run:
        return [(each.number, each.mean, each.best, each.sigma) for each in run.history()]


@pytest.mark.slow
def test_a_worker_that_started_first_waits_fetches_the_bundle_and_leaves_when_the_run_is_over(processes, settings):
    worker = processes.worker("--task", tasks.TOY, "--exit-when-done")
    worker.wait_for_event("no coordinator")
    coordinator = processes.coordinator(*settings, "--task", tasks.TOY, "--generations", 3)
    worker.wait_for_event("fetched")
    assert coordinator.finish()[0] == 0
    assert worker.finish()[0] == 0
    assert [number for number, *_ in history(processes)] == [0, 1, 2]


def test_the_mean_is_evaluated_on_schedule_and_at_the_end_and_the_target_ends_the_run(processes, random_bundle):
    coordinator = processes.coordinator(
        "--bundle", random_bundle.path, "--task", tasks.TOY, "--population", 8, "--episodes", 1, "--sigma0", 0.2,
        "--evaluate-every", 5, "--evaluation-episodes", 3, "--generations", 400, "--target", -4,
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
def test_status_is_json_that_zenoh_cli_reads_too(processes, settings):
    coordinator = processes.coordinator(*settings, "--task", tasks.SLOW_TOY, "--generations", 1000)
    processes.worker("--task", tasks.SLOW_TOY)
    coordinator.wait_for_event("generation", number=1)
    ours = processes.status()
    assert (ours["schema"], ours["run"], ours["state"], ours["slots"]) == (2, "test", "running", 1)
    assert ours["worker_list"][0]["state"] == "present"
    tool = Path(sys.executable).parent / "zenoh"
    command = [tool, "--mode", "client", "--connect", processes.endpoint, "get", "-s", "dreamfleet/v2/test/status"]
    done = subprocess.run(
        [*command, "--decoder", "json"], capture_output=True, check=False, text=True, timeout=DEADLINE
    )
    theirs = json.loads(
        done.stdout.strip().splitlines()[-1].split(":", 1)[-1] if done.stdout[:1] != "{" else done.stdout
    )
    assert theirs["run_uid"] == ours["run_uid"]
    assert processes.call("status", "--connect", processes.endpoint)[0] == 0


def test_a_second_coordinator_of_a_live_run_is_refused(processes, settings):
    processes.coordinator(*settings, "--task", tasks.SLOW_TOY, "--generations", 1000)
    elsewhere = f"tcp/127.0.0.1:{free_port()}"
    code, *_ = call_here("coordinator", "--resume", "test", "--runs-dir", processes.runs, "--listen", elsewhere)
    assert code != 0


def test_a_foreign_coordinator_on_the_same_network_is_refused(processes, settings, tmp_path):
    processes.coordinator(*settings, "--task", tasks.SLOW_TOY, "--generations", 1000)
    code, *_ = call_here(
        "coordinator", "--run", "test", "--runs-dir", tmp_path / "elsewhere", "--connect", processes.endpoint,
        *settings, "--generations", 1,
    )  # fmt: skip
    assert code != 0
    assert not (tmp_path / "elsewhere").exists(), "a run that cannot be served is not created"


@pytest.mark.parametrize("flag", ["--listen", "--metrics-port"])
def test_a_new_run_whose_port_is_taken_is_not_created(processes, settings, flag):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = f"127.0.0.1:{other.getsockname()[1]}"
        where = ("--listen", f"tcp/{taken}") if flag == "--listen" else ("--listen", processes.endpoint, flag, taken)
        code, _, err = call_here("coordinator", "--run", "test", "--runs-dir", processes.runs, *where, *settings)
    assert code == 1
    assert taken in err
    assert flag in err
    assert not processes.runs.exists()


@pytest.mark.slow
def test_pause_resume_and_drain_from_the_command_line(processes, settings):
    coordinator = processes.coordinator(*settings, "--task", tasks.SLOW_TOY, "--generations", 500)
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
    code, _ = coordinator.finish()
    assert code == 130
    assert coordinator.lines[-1].rstrip().endswith(drained["continue"])
    assert f"--resume test --runs-dir {processes.runs}" in drained["continue"]
    with open_run(processes.runs, "test") as run:
        assert run.ended is None
        number = len(run.history())
        assert len([each for i in range(4) for each in run.results(number, i)]) <= 8


@pytest.mark.slow
def test_a_fork_begins_where_its_run_was_and_may_change_what_is_frozen(processes, settings, tmp_path):
    first = processes.coordinator(*settings, "--task", tasks.TOY, "--generations", 3)
    processes.worker("--task", tasks.TOY, "--exit-when-done")
    assert first.finish()[0] == 0
    common = ("--runs-dir", processes.runs, "--listen", processes.endpoint, "--generations", 1, "--beat", "0.2")
    fork = processes.start("coordinator", "--from", "test", "--population", 6, *common)
    processes.worker("--task", tasks.TOY, "--run", "test-fork")
    assert fork.finish()[0] == 0
    with open_run(processes.runs, "test") as one, open_run(processes.runs, "test-fork") as other:
        before, sigma = latest_mean_and_sigma(one)
        start = other.history()[0]
        assert other.settings.population == 6
        assert start.sigma == pytest.approx(sigma)
        population = np.stack([other.candidate(0, i) for i in range(6)])
        assert np.abs(population - before).max() < 6 * sigma
        assert np.abs(before).max() > 0
    from_controller = processes.start("coordinator", "--run", "third", "--init", "test", *settings, "--task", tasks.TOY,
                                      *common)  # fmt: skip
    processes.worker("--task", tasks.TOY, "--run", "third")
    assert from_controller.finish()[0] == 0


def test_parameters_of_another_world_model_are_no_beginning(processes, settings):
    code, _, err = call_here("coordinator", "--runs-dir", processes.runs, *settings, "--init", "tiny")
    assert code != 0
    assert " tiny " in err


@pytest.mark.slow
def test_several_runs_on_one_router_never_see_each_other_and_a_worker_serves_the_neediest(processes, settings):
    """The second coordinator connects to the first one's router."""
    first = processes.coordinator(*settings, "--task", tasks.SLOW_TOY, "--generations", 9, name="first")
    second = processes.start(
        "coordinator", "--run", "second", "--runs-dir", processes.runs, "--connect", processes.endpoint,
        *settings, "--seed", 9, "--beat", "0.2", "--task", tasks.SLOW_TOY, "--generations", 3,
    )  # fmt: skip
    second.wait_for_event("begin")
    workers = []
    for number in range(2):
        workers.append(processes.worker("--task", tasks.SLOW_TOY, "--any", "--runs", 1, "--name", f"any{number}"))
        workers[-1].wait_for_event("joined")
        while not all(each.slots for each in processes.statuses()[: number + 1]):
            pass
    joined = [event["run"] for each in workers for event in each.events("joined")]
    assert sorted(joined) == ["first", "second"]
    assert second.finish()[0] == 0
    assert first.finish()[0] == 0
    assert [number for number, *_ in history(processes, "second")] == [0, 1, 2]
    with open_run(processes.runs, "first") as one, open_run(processes.runs, "second") as other:
        assert one.results(0, 0)[0].worker != other.results(0, 0)[0].worker
