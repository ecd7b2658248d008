"""Hosts that allow a process few open files."""

import pytest

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.transport.session import Network, open_session
from tests.support import tasks


def at_most(files):
    """The words that start a program which may open so many."""
    return ("bash", "-c", f'ulimit -n {files}; exec "$@"', "-")


@pytest.mark.parametrize("files", [12, 40])
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
        "--bundle", random_bundle.path, "--task", tasks.SLOW_TOY, "--population", 4, "--evaluate-every", 1,
        "--evaluation-episodes", 1, "--generations", 4, inside=at_most(120),
    )  # fmt: skip
    coordinator.wait_for("incarnation")
    processes.worker("--task", tasks.SLOW_TOY).wait_for("joined")
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
