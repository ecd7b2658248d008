"""Two coordinators of one name: whenever they see each other one of them leaves, and nobody leaves for a ghost.
Tests coordinator/service/name_lock.py."""

import re
import shutil
import signal
import time

import pytest

from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.transport.session import Network, open_session
from tests.support import tasks
from tests.support.processes import DEADLINE, free_port
from tests.support.relay import Relay


@pytest.fixture
def settings(random_bundle):
    return ("--bundle", random_bundle.path, "--population", 4, "--episodes", 1, "--evaluate-every", 0,
            "--task", tasks.SLOW_TOY, "--beat", "0.2")  # fmt: skip


def begin(processes, runs, endpoint, *flags):
    words = ("--runs-dir", runs, "--listen", endpoint)
    coordinator = processes.start("coordinator", *words, *flags)
    coordinator.wait_for_event("begin")
    return coordinator


def link(*endpoints):
    """A router that both are connected to."""
    return open_session(Network(listen=(f"tcp/127.0.0.1:{free_port()}",), connect=endpoints))


def ended(*coordinators):
    deadline = time.monotonic() + DEADLINE
    while time.monotonic() < deadline:
        if found := [each for each in coordinators if each.popen.poll() is not None]:
            return found
        time.sleep(0.01)
    return []


@pytest.mark.slow
def test_of_two_on_routers_that_are_linked_later_the_newcomer_leaves_and_the_other_goes_on(processes, settings):
    first_at, second_at = processes.endpoint, f"tcp/127.0.0.1:{free_port()}"
    first = begin(processes, processes.folder / "a", first_at, "--run", "test", *settings)
    second = begin(processes, processes.folder / "b", second_at, "--run", "test", *settings)
    processes.worker("--task", tasks.SLOW_TOY)
    processes.worker("--task", tasks.SLOW_TOY, endpoint=second_at)
    for each in (first, second):
        each.wait_for_event("generation", number=0)
    with link(first_at, second_at):
        assert ended(first, second) == [second]
        assert second.finish()[0] == 1
        first.wait_for_event("generation", times=2)
    with open_run(processes.folder / "b", "test") as run:
        assert len(run.history()) >= 1


@pytest.mark.slow
def test_of_two_copies_of_one_run_the_one_that_was_continued_last_goes_on(processes, settings):
    first_at, second_at = processes.endpoint, f"tcp/127.0.0.1:{free_port()}"
    made = begin(processes, processes.folder / "a", first_at, "--run", "test", *settings)
    made.popen.send_signal(signal.SIGTERM)
    assert made.finish()[0] == 130
    shutil.copytree(processes.folder / "a", processes.folder / "b")
    begin(processes, processes.folder / "b", second_at, "--resume", "test").popen.send_signal(signal.SIGKILL)
    first = begin(processes, processes.folder / "a", first_at, "--resume", "test")  # its second life
    second = begin(processes, processes.folder / "b", second_at, "--resume", "test")  # its third
    with link(first_at, second_at):
        assert ended(first, second) == [first]
    assert re.search(r"\b3\b", first.last_line()), "the incarnation of the other"


@pytest.mark.slow
def test_a_frozen_predecessor_that_comes_back_leaves_and_its_token_hurts_nobody(processes, settings):
    """Both are clients of one router: the token of the frozen one lingers until its lease is over."""
    with open_session(Network(listen=(processes.endpoint,))):
        words = ("--connect", processes.endpoint)
        made = processes.start("coordinator", "--run", "test", "--runs-dir", processes.folder / "a", *words, *settings)
        made.wait_for_event("begin")
        made.popen.send_signal(signal.SIGTERM)
        made.finish()
        old = processes.start("coordinator", "--resume", "test", "--runs-dir", processes.folder / "a", *words)
        old.wait_for_event("begin")
        shutil.copytree(processes.folder / "a", processes.folder / "b")
        old.popen.send_signal(signal.SIGSTOP)
        new = processes.start("coordinator", "--resume", "test", "--runs-dir", processes.folder / "b", *words)
        new.wait_for_event("begin", incarnation=3)
        old.popen.send_signal(signal.SIGCONT)
        assert ended(old, new) == [old]
        processes.worker("--task", tasks.SLOW_TOY)
        new.wait_for_event("generation", number=0)


@pytest.mark.slow
def test_a_coordinator_that_is_killed_and_continued_at_once_goes_on_and_so_does_one_whose_link_is_cut(
    processes, settings
):
    with open_session(Network(listen=(processes.endpoint,))):
        relay = Relay(processes.port)
        words = ("--runs-dir", processes.runs, "--connect", relay.endpoint)
        killed = processes.start("coordinator", "--run", "test", *words, *settings)
        killed.wait_for_event("begin")
        killed.popen.kill()
        killed.popen.wait()
        again = processes.start("coordinator", "--resume", "test", *words)
        again.wait_for_event("begin", incarnation=2)
        for _ in range(3):
            relay.cut()
            time.sleep(1.5)
        processes.worker("--task", tasks.SLOW_TOY)
        again.wait_for_event("generation", number=0)
        assert again.popen.poll() is None
        again.end()
        relay.close()
