"""Readers that sleep: stderr and stdout whose pipe is full to the brim."""

import os
import signal
import subprocess
from contextlib import ExitStack

import pytest

from dreamfleet.common.host.processes import command
from tests.support import tasks
from tests.support.processes import DEADLINE, environment, started

WORKER = ("worker", "--slots", 1, "--task")


def brimful():
    """A pipe that takes not one byte more; both its ends."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    for size in (4096, 1):
        try:
            while True:
                os.write(write, bytes(size))
        except BlockingIOError:
            continue
    os.set_blocking(write, True)
    return read, write


@pytest.fixture
def frozen(processes):
    """Start a verb nobody reads the words of: on stderr, or also what it answers on stdout."""
    with ExitStack() as stack:

        def start(*words, stdout=False):
            read, write = brimful()
            for end in (read, write):
                stack.callback(os.close, end)
            out = write if stdout else subprocess.DEVNULL
            how = {"env": environment(processes.cache), "stdin": subprocess.DEVNULL, "stdout": out, "stderr": write}
            return stack.enter_context(started(command(*words), **how))

        yield start


@pytest.fixture
def run(processes, small):
    """The words that begin a run that says much."""
    where = ("--run", "test", "--runs-dir", processes.runs, "--listen", processes.endpoint, "--beat", 0.2)
    return ("coordinator", *where, *small, "--log-level", "debug")


@pytest.mark.slow
def test_a_task_that_prints_without_end_scores_although_nobody_reads_it(processes, run, frozen):
    coordinator = frozen(*run, "--task", tasks.CHATTY, "--generations", 2)
    frozen(*WORKER, tasks.CHATTY, "--connect", processes.endpoint, stdout=True)
    assert coordinator.wait(DEADLINE) == 0


@pytest.mark.slow
def test_who_is_not_read_still_hears_that_it_shall_leave(processes, run, frozen):
    coordinator = frozen(*run)
    worker = frozen(*WORKER, tasks.SLOW_TOY, "--connect", processes.endpoint)
    while not (status := processes.status()) or status["generations"] < 1:
        pass
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(DEADLINE) == 0
    coordinator.send_signal(signal.SIGTERM)
    assert coordinator.wait(DEADLINE) == 130


@pytest.mark.slow
def test_an_answer_that_nobody_reads_waits_and_a_signal_ends_it(processes, run, frozen):
    coordinator = frozen(*run, "--task", tasks.TOY, "--generations", 1, "--json", stdout=True)
    worker = frozen(*WORKER, tasks.TOY, "--connect", processes.endpoint, "--exit-when-done")
    assert worker.wait(DEADLINE) == 0, "the run has ended"
    with pytest.raises(subprocess.TimeoutExpired):
        coordinator.wait(2)
    coordinator.send_signal(signal.SIGTERM)
    assert coordinator.wait(DEADLINE) == -signal.SIGTERM
