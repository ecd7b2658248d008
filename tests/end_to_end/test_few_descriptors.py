"""Hosts that allow a process few open files."""

import os
import shutil

import pytest

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.transport.session import Network, open_session
from tests.support import tasks


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
    try:
        while len(strangers) < 100:
            strangers.append(open_session(Network(connect=(processes.endpoint,)), timeout=5))
    except DreamfleetError:
        pass  # no more are let in
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
