"""Two coordinators of one name: whenever they see each other one of them leaves, and nobody leaves for a ghost.
Tests coordinator/service/name_lock.py."""

import shutil
import signal
import time

import pytest

from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.transport.session import Network, open_session
from tests.support import tasks
from tests.support.processes import free_port, until
from tests.support.relay import Relay


def start(processes, folder, *words):
    coordinator = processes.start("coordinator", "--runs-dir", processes.folder / folder, *words)
    coordinator.wait_for_event("begin")
    return coordinator


def check_that_leaves(leaving, staying):
    until(lambda: leaving.popen.poll() is not None)
    assert leaving.finish()[0] == 1
    assert staying.popen.poll() is None


@pytest.mark.slow
def test_of_two_on_routers_that_are_linked_later_the_newcomer_leaves_and_the_other_goes_on(processes, small):
    first_at, second_at = processes.endpoint, f"tcp/127.0.0.1:{free_port()}"
    first = start(processes, "a", "--run", "test", "--listen", first_at, *small)
    second = start(processes, "b", "--run", "test", "--listen", second_at, *small)
    for coordinator, endpoint in ((first, first_at), (second, second_at)):
        processes.worker("--task", tasks.SLOW_TOY, endpoint=endpoint)
        coordinator.wait_for_event("generation", number=0)
    with open_session(Network(listen=(f"tcp/127.0.0.1:{free_port()}",), connect=(first_at, second_at))):
        check_that_leaves(second, first)
        first.wait_for_event("generation", times=2)
    with open_run(processes.folder / "b", "test") as run:
        assert len(run.history()) >= 1


@pytest.mark.slow
def test_a_frozen_predecessor_that_comes_back_leaves_and_its_token_hurts_nobody(processes, small):
    """Both are clients of one router: the token of the frozen one lingers until its lease is over."""
    with open_session(Network(listen=(processes.endpoint,))):
        words = ("--connect", processes.endpoint)
        made = start(processes, "a", "--run", "test", *words, *small)
        made.popen.send_signal(signal.SIGTERM)
        made.finish()
        old = start(processes, "a", "--resume", "test", *words)
        shutil.copytree(processes.folder / "a", processes.folder / "b")
        old.popen.send_signal(signal.SIGSTOP)
        new = start(processes, "b", "--resume", "test", *words)
        assert new.events("begin", incarnation=3)
        old.popen.send_signal(signal.SIGCONT)
        check_that_leaves(old, new)
        processes.worker("--task", tasks.SLOW_TOY)
        new.wait_for_event("generation", number=0)


@pytest.mark.slow
def test_a_coordinator_that_is_killed_and_continued_at_once_goes_on_and_so_does_one_whose_link_is_cut(processes, small):
    with open_session(Network(listen=(processes.endpoint,))):
        relay = Relay(processes.port)
        words = ("--connect", relay.endpoint)
        killed = start(processes, "runs", "--run", "test", *words, *small)
        killed.popen.kill()
        killed.popen.wait()
        again = start(processes, "runs", "--resume", "test", *words)
        for _ in range(3):
            relay.cut()
            time.sleep(1.5)
        processes.worker("--task", tasks.SLOW_TOY)
        again.wait_for_event("generation", number=0)
        assert again.popen.poll() is None
        again.end()
        relay.close()
