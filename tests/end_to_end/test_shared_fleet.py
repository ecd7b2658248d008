"""One fleet that serves several runs: each has the bits that it has alone, and none holds up another."""

import os
import signal
from contextlib import suppress
from pathlib import Path

import pytest

from tests.support import tasks
from tests.support.same_bits import outcome

POPULATION, GENERATIONS = 4, 4
FLAGS = ("--task", tasks.SLOW_TOY)


@pytest.fixture
def settings(random_bundle):
    return (
        "--bundle", random_bundle.path, "--population", POPULATION, "--episodes", 2, "--evaluate-every", 0,
    )  # fmt: skip


@pytest.fixture
def router(processes):
    processes.start("router", "--listen", processes.endpoint)


def run_beside(processes, name, *arguments):
    """A coordinator that meets its workers at the router."""
    made = processes.start(
        "coordinator", "--run", name, "--runs-dir", processes.runs, "--connect", processes.endpoint, "--beat", "0.2",
        *arguments,
    )  # fmt: skip
    made.wait_for_event("begin")
    return made


def children(worker):
    """The process ids of a worker's scoring processes."""
    found = []
    for entry in os.scandir("/proc"):
        if entry.name.isdigit():
            with suppress(OSError):
                parent = Path(f"/proc/{entry.name}/stat").read_text().rpartition(") ")[2].split()[1]
                if (
                    parent == str(worker.popen.pid)
                    and b"spawn_main" in Path(f"/proc/{entry.name}/cmdline").read_bytes()
                ):
                    found.append(int(entry.name))
    return found


def any_worker(processes, *arguments):
    worker = processes.worker(*FLAGS, "--any", *arguments)
    worker.wait_for_event("joined", times=2)
    return worker


@pytest.mark.slow
def test_two_runs_have_the_bits_of_each_alone_though_a_worker_and_a_slot_are_killed(processes, router, settings):
    settings = (*settings, "--generations", GENERATIONS)
    seeds, alone = {"one": 5, "two": 9}, {}
    for name, seed in seeds.items():
        coordinator = run_beside(processes, f"{name}-alone", *settings, "--seed", seed, "--task", tasks.TOY)
        worker = processes.worker("--task", tasks.TOY, "--run", f"{name}-alone")
        assert coordinator.finish()[0] == 0
        worker.end()
        alone[name] = outcome(processes, f"{name}-alone")
    shared = {name: run_beside(processes, name, *settings, *FLAGS, "--seed", seed) for name, seed in seeds.items()}
    stays, dies = (any_worker(processes, "--name", name) for name in ("stays", "dies"))
    shared["one"].wait_for_event("generation", number=0)
    os.kill(children(stays)[0], signal.SIGKILL)
    shared["two"].wait_for_event("generation", number=1)
    os.kill(dies.popen.pid, signal.SIGKILL)
    for name, coordinator in shared.items():
        assert coordinator.finish()[0] == 0
        assert outcome(processes, name) == alone[name]


@pytest.mark.long
def test_a_paused_run_and_one_whose_coordinator_was_killed_hold_up_no_other(processes, router, settings):
    endless = (*settings, *FLAGS, "--generations", 10**6)
    one, two = (run_beside(processes, name, *endless) for name in ("one", "two"))
    worker = any_worker(processes)
    assert processes.call("pause", "one", "--connect", processes.endpoint)[0] == 0
    one.wait_for_event("paused")
    two.wait_for_event("generation", times=3)
    assert processes.call("resume", "one", "--connect", processes.endpoint)[0] == 0
    one.wait_for_event("generation", times=2)
    os.kill(one.popen.pid, signal.SIGKILL)
    two.wait_for_event("generation", times=3)
    assert worker.popen.poll() is None
    worker.popen.send_signal(signal.SIGTERM)
    assert worker.finish()[0] == 0
