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


@pytest.mark.slow
@pytest.mark.parametrize("files", [pytest.param(12, marks=pytest.mark.long), 40])
def test_a_worker_without_descriptors_for_its_slots_ends_and_says_so(processes, random_bundle, files):
    processes.coordinator("--bundle", random_bundle.path, "--task", tasks.SLOW_TOY, "--population", 4)
    worker = processes.worker("--task", tasks.SLOW_TOY, "--slots", 8, inside=at_most(files))
    assert worker.finish()[0] == 1
    assert "ulimit -n" in worker.lines[-1]
    assert not any("Traceback" in line for line in worker.lines)


@pytest.mark.slow
def test_strangers_cannot_take_a_coordinators_last_descriptor(processes, random_bundle):
    coordinator = processes.start(
        "coordinator", "--run", "test", "--runs-dir", processes.runs, "--listen", processes.endpoint, "--beat", "0.2",
        "--bundle", random_bundle.path, "--task", tasks.SLOW_TOY, "--population", 4, "--episodes", 1,
        "--evaluate-every", 1, "--evaluation-episodes", 1, "--confirm-episodes", 2, "--generations", 4,
        inside=at_most(120),
    )  # fmt: skip
    coordinator.wait_for_event("begin")
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
def test_a_limit_that_fits_no_session_is_one_line(processes, random_bundle, files, verb):
    words = {
        "worker": ("--connect", processes.endpoint),
        "status": ("--connect", processes.endpoint),
        "router": ("--listen", processes.endpoint),
        "coordinator": (
            "--listen", processes.endpoint, "--run", "test", "--runs-dir", processes.runs, "--task", tasks.TOY,
            "--bundle", random_bundle.path,
        ),
    }[verb]  # fmt: skip
    process = processes.start(verb, *words, inside=at_most(files))
    assert process.finish()[0] == 1
    said = "".join(process.lines)
    assert "ulimit -n" in process.lines[-1]
    assert "panicked" not in said
    assert "Traceback" not in said


@pytest.mark.slow
@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("setpriv"), reason="needs another user, without processes")
@pytest.mark.parametrize(
    ("verb", "processes_allowed"),
    [("coordinator", 16), ("worker", 8), *(pytest.param("worker", each, marks=pytest.mark.long) for each in (2, 24))],
)
def test_a_user_with_few_processes_gets_one_line_and_no_traceback(processes, random_bundle, processes_allowed, verb):
    able = "+dac_override,+dac_read_search"  # to read this interpreter and write its own run
    other = (
        "setpriv", "--reuid=54321", "--clear-groups", f"--inh-caps={able}", f"--ambient-caps={able}",
        "bash", "-c", f'ulimit -u {processes_allowed}; exec "$@"', "-",
    )  # fmt: skip
    flags = ("--run", "test", "--task", tasks.TOY)
    words = {
        "worker": ("--connect", processes.endpoint, "--slots", 8, *flags),
        "coordinator": (
            "--listen", processes.endpoint, *flags, "--runs-dir", processes.runs, "--bundle", random_bundle.path,
        ),
    }[verb]  # fmt: skip
    if verb == "worker":  # where it can join, it lacks room for its slots
        processes.coordinator("--bundle", random_bundle.path, "--task", tasks.TOY)
    process = processes.start(verb, *words, inside=other)
    code, said = process.finish()[0], "".join(process.lines)
    assert code == 1, said
    assert "ulimit -u" in process.lines[-1]
    assert "panicked" not in said
    assert "Traceback" not in said
