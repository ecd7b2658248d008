"""Hosts that allow a process few open files, and readers that sleep: a pipe is full to the brim.
Tests common/host/resource_limits.py and common/host/standard_streams.py."""

import os
import shutil
import signal
import subprocess
from contextlib import ExitStack, suppress

import pytest

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host.processes import command
from dreamfleet.common.transport.session import Network, open_session
from tests.support import tasks
from tests.support.processes import DEADLINE, environment, started


def at_most(files):
    """The words that start a program which may open so many."""
    return ("bash", "-c", f'ulimit -n {files}; exec "$@"', "-")


def words_of(verb, processes, small):
    where = "--connect" if verb in ("worker", "status") else "--listen"
    run = ("--run", "test", "--runs-dir", processes.runs, *small) if verb == "coordinator" else ()
    return verb, where, processes.endpoint, *run


def check_one_line(process, datum):
    code, said = process.finish()[0], "".join(process.lines)
    assert (code, datum in process.lines[-1]) == (1, True), said
    assert "panicked" not in said
    assert "Traceback" not in said


@pytest.mark.slow
@pytest.mark.parametrize("files", [pytest.param(12, marks=pytest.mark.long), 40])
def test_a_worker_without_descriptors_for_its_slots_ends_and_says_so(processes, small, files):
    processes.coordinator(*small)
    worker = processes.worker("--task", tasks.SLOW_TOY, "--slots", 8, inside=at_most(files))
    check_one_line(worker, "ulimit -n")


@pytest.mark.slow
def test_strangers_cannot_take_a_coordinators_last_descriptor(processes, small):
    judged = ("--evaluate-every", 1, "--evaluation-episodes", 1, "--confirm-episodes", 2)
    coordinator = processes.coordinator(*small, *judged, "--generations", 4, inside=at_most(120))
    processes.worker("--task", tasks.SLOW_TOY).wait_for_event("joined")
    strangers = []
    with suppress(DreamfleetError):  # no more are let in
        while len(strangers) < 100:
            strangers.append(open_session(Network(connect=(processes.endpoint,)), timeout=5))
    assert 20 < len(strangers) < 100
    assert coordinator.finish()[0] == 0
    assert (processes.runs / "test" / "controller.npz").exists()
    for each in strangers:
        each.close()


@pytest.mark.parametrize("files", [10, 16])
@pytest.mark.parametrize("verb", ["worker", "status", "coordinator", "router"])
def test_a_limit_that_fits_no_session_is_one_line(processes, small, files, verb):
    check_one_line(processes.start(*words_of(verb, processes, small), inside=at_most(files)), "ulimit -n")


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("setpriv"), reason="needs another user, without processes")
@pytest.mark.parametrize(
    ("verb", "processes_allowed"),
    [("coordinator", 16), ("worker", 8), *(pytest.param("worker", each, marks=pytest.mark.long) for each in (2, 24))],
)
def test_a_user_with_few_processes_gets_one_line_and_no_traceback(processes, small, processes_allowed, verb):
    able = "+dac_override,+dac_read_search"  # to read this interpreter and write its own run
    other = (
        "setpriv", "--reuid=54321", "--clear-groups", f"--inh-caps={able}", f"--ambient-caps={able}",
        "bash", "-c", f'ulimit -u {processes_allowed}; exec "$@"', "-",
    )  # fmt: skip
    if verb == "worker":  # where it can join, it lacks room for its slots
        processes.coordinator(*small)
    slots = ("--slots", 8, "--task", tasks.SLOW_TOY) if verb == "worker" else ()
    check_one_line(processes.start(*words_of(verb, processes, small), *slots, inside=other), "ulimit -u")


WORKER = ("worker", "--slots", 1, "--task")


def brimful():
    """A pipe that takes not one byte more; both its ends."""
    read, write = os.pipe()
    os.set_blocking(write, False)
    with suppress(BlockingIOError):
        while True:
            os.write(write, b"x")
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
