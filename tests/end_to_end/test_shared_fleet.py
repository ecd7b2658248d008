"""One fleet that serves several runs: each has the bits that it has alone, and none holds up another."""

import os
import signal
from pathlib import Path

import pytest

from tests.support import tasks
from tests.support.same_bits import outcome


def a_slot_of(worker):
    """The process id of one of its scoring processes, not of multiprocessing's resource tracker."""
    children = Path(f"/proc/{worker.popen.pid}/task").glob("*/children")
    found = (int(each) for listed in children for each in listed.read_text().split())
    return next(each for each in found if b"spawn_main" in Path(f"/proc/{each}/cmdline").read_bytes())


@pytest.mark.slow
def test_two_runs_have_the_bits_of_each_alone_though_a_worker_and_a_slot_are_killed(processes, small):
    processes.start("router", "--listen", processes.endpoint)

    def begin(name, seed, *more):
        """Their workers meet at the router."""
        flags = (*small, "--episodes", 2, "--generations", 4, "--seed", seed, *more)
        return processes.coordinator(*flags, name=name, at=("--connect", processes.endpoint))

    seeds, alone = {"one": 5, "two": 9}, {}
    for name, seed in seeds.items():
        coordinator = begin(f"{name}-alone", seed, "--task", tasks.TOY)
        worker = processes.worker("--task", tasks.TOY, "--run", f"{name}-alone")
        assert coordinator.finish()[0] == 0
        worker.end()
        alone[name] = outcome(processes, f"{name}-alone")
    shared = {name: begin(name, seed) for name, seed in seeds.items()}
    workers = [processes.worker("--task", tasks.SLOW_TOY, "--any", "--name", name) for name in ("stays", "dies")]
    for each in workers:
        each.wait_for_event("joined", times=2)
    stays, dies = workers
    shared["one"].wait_for_event("generation", number=0)
    os.kill(a_slot_of(stays), signal.SIGKILL)
    shared["two"].wait_for_event("generation", number=1)
    os.kill(dies.popen.pid, signal.SIGKILL)
    for name, coordinator in shared.items():
        assert coordinator.finish()[0] == 0
        assert outcome(processes, name) == alone[name]
