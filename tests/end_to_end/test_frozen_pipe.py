"""Readers that sleep: stderr and stdout whose pipe is full to the brim."""

import os
import signal
import subprocess

import pytest

from dreamfleet.common.host.processes import command
from tests.support import tasks
from tests.support.processes import DEADLINE, environment

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
    started, ends = [], []

    def start(*words, stdout=False):
        read, write = brimful()
        ends.extend((read, write))
        popen = subprocess.Popen(
            command(*words), env=environment(processes.cache), stdin=subprocess.DEVNULL,
            stdout=write if stdout else subprocess.DEVNULL, stderr=write,
        )  # fmt: skip
        started.append(popen)
        return popen

    yield start
    for popen in started:
        popen.kill()
        popen.wait()
    for end in ends:
        os.close(end)


def coordinator(processes, bundle, task, generations, *more):
    return (
        "coordinator", "--run", "test", "--runs-dir", processes.runs, "--listen", processes.endpoint, "--beat", "0.2",
        "--bundle", bundle.path, "--task", task, "--population", 4, "--evaluate-every", 0, "--generations", generations,
        "--log-level", "debug", *more,
    )  # fmt: skip


@pytest.mark.slow
def test_a_run_ends_although_nobody_reads_what_its_processes_log(processes, random_bundle, frozen):
    run = frozen(*coordinator(processes, random_bundle, tasks.TOY, 5))
    worker = frozen(*WORKER, tasks.TOY, "--connect", processes.endpoint, "--exit-when-done", "--log-level", "debug")
    assert run.wait(DEADLINE) == 0
    assert worker.wait(DEADLINE) == 0


@pytest.mark.slow
def test_a_task_that_prints_without_end_scores_although_nobody_reads_it(processes, random_bundle, frozen):
    run = frozen(*coordinator(processes, random_bundle, tasks.CHATTY, 2))
    frozen(*WORKER, tasks.CHATTY, "--connect", processes.endpoint, stdout=True)
    assert run.wait(DEADLINE) == 0


@pytest.mark.slow
def test_who_is_not_read_still_hears_that_it_shall_leave(processes, random_bundle, frozen):
    run = frozen(*coordinator(processes, random_bundle, tasks.SLOW_TOY, 1000, "--episodes", 1))
    worker = frozen(*WORKER, tasks.SLOW_TOY, "--connect", processes.endpoint)
    while not (status := processes.status()) or status["generations"] < 1:
        pass
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(DEADLINE) == 0
    run.send_signal(signal.SIGTERM)
    assert run.wait(DEADLINE) == 130


@pytest.mark.slow
def test_an_answer_that_nobody_reads_waits_and_a_signal_ends_it(processes, random_bundle, frozen):
    run = frozen(*coordinator(processes, random_bundle, tasks.TOY, 1, "--json"), stdout=True)
    worker = frozen(*WORKER, tasks.TOY, "--connect", processes.endpoint, "--exit-when-done")
    assert worker.wait(DEADLINE) == 0, "the run has ended"
    with pytest.raises(subprocess.TimeoutExpired):
        run.wait(2)
    run.send_signal(signal.SIGTERM)
    assert run.wait(DEADLINE) == -signal.SIGTERM
