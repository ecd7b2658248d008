"""When and how a worker leaves."""

import subprocess
import sys
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta
from itertools import chain, repeat
from unittest.mock import Mock

import pytest

from dreamfleet.common.errors import AccessError, ConnectionFailedError
from dreamfleet.common.security.credentials import Credentials
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.worker.service import membership, worker
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.worker import Worker
from tests.support import tasks
from tests.support.hand import DEADLINE
from tests.support.processes import free_port
from tests.support.stage import drained, wait_for


@pytest.mark.parametrize("stopped", [False, True])
def test_it_leaves_and_says_why_when_it_is_stopped_or_its_coordinator_ends_the_run(stage, cached, stopped):
    hand, made, served = stage.served(tasks.SLOW_TOY, exit_when_done=not stopped)
    if stopped:
        made.stop()
    else:
        hand.send(1, hand.job())
        hand.beat(lambda beat: beat.running)
        hand.send(0, vectors=(), ended=True)
    hand.beat(lambda beat: beat.reason)
    assert served.result(DEADLINE) is None


@pytest.mark.parametrize("joined", [False, True])
def test_with_exit_when_done_it_fails_after_long_without_a_coordinator_and_says_what_is_lost(stage, cached, joined):
    hand = stage.hand()
    if not joined:
        hand.vanish()
    _, served = stage.worker(exit_when_done=True, coordinator_timeout=0.5)
    hand.hello()
    if joined:
        hand.beat(lambda beat: beat.capacity > 0)
        hand.send(1, hand.job())
        hand.result(hand.job())
        hand.vanish()
    error = served.exception(DEADLINE)
    assert isinstance(error, ConnectionFailedError)
    assert ("1 finished result" in str(error)) == joined
    assert "--coordinator-timeout" in str(error)


@pytest.mark.parametrize("listens", [False, True])
def test_with_exit_when_done_it_also_ends_where_no_coordinator_ever_let_it_in(listens):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = WorkerConfig(slots=1, exit_when_done=True, coordinator_timeout=0.1)
    router = open_session(Network(listen=(endpoint,))) if listens else nullcontext()
    with router, pytest.raises(ConnectionFailedError, match=r"--coordinator-timeout"):
        Worker(config, Network(connect=(endpoint,))).serve()


def test_a_worker_that_a_secured_router_shows_nothing_says_so_once(stage, said, cached, monkeypatch):
    monkeypatch.setattr(membership, "SEARCH_INTERVAL", 0.05)
    hand, made, _ = stage.served()
    object.__setattr__(made._link, "secured", True)  # frozen; a hand answers only hellos of an open fleet
    hand.vanish()
    wait_for(said, "shut out")
    hand.appear()
    hand.vanish()
    wait_for(said, "shut out")


def test_it_says_why_it_fails_before_it_can_score(stage):
    hand = stage.hand()
    hand.total = lambda: 1 << 60
    error, said = stage.error(), hand.beat()
    assert (said.capacity, said.reason) == (0, str(error))


def test_stopped_once_it_finishes_running_jobs_and_delivers_and_all_others_go_back(stage, cached):
    hand, made, served = stage.served(tasks.SLOW_TOY)
    running, queued, late = (hand.job(number) for number in range(3))
    hand.send(1, running, queued)
    hand.beat(lambda beat: beat.running)
    made.stop()
    assert hand.beat(lambda beat: beat.capacity == 0).queued == ()
    hand.send(2, late)
    assert hand.beat(lambda beat: beat.seen == 2).queued == ()
    assert hand.result(running).fitness is not None
    assert not served.done()
    hand.send(3, accepted=(running,))
    assert served.result(DEADLINE) is None


def test_stopped_once_it_abandons_a_download(stage):
    hand = stage.hand()
    hand.damage = lambda offset, data: None
    made, served = stage.worker()
    hand.offsets.get(timeout=DEADLINE)
    made.stop()
    assert served.result(2) is None


@pytest.mark.parametrize("coordinator", [False, True])
def test_its_lifetime_ends_without_a_run_too(stage, coordinator):
    if coordinator:
        stage.hand(run="another")
    _, served = stage.worker(lifetime=0.5)
    assert served.result(DEADLINE) is None


def test_a_worker_whose_host_slept_past_the_end_of_its_join_file_leaves(stage, monkeypatch):
    left = chain([timedelta(days=2)] * 3, repeat(timedelta(days=-1)))
    monkeypatch.setattr(Credentials, "time_left", property(lambda _: next(left)))
    monkeypatch.setattr(worker, "open_session", Mock(side_effect=ConnectionFailedError))
    credentials = Credentials("worker", 1, "first", datetime.now(UTC), ca="")
    network = Network(connect=(f"tls/127.0.0.1:{free_port()}",), credentials=credentials)
    assert isinstance(stage.worker(network=network)[1].exception(DEADLINE), AccessError)


def test_late_events_of_the_last_runs_slots_do_not_reach_the_next_run(stage, said, cached, monkeypatch):
    monkeypatch.setattr(membership, "NEXT_RUN_AFTER", 0.3)
    hand = stage.hand(run="one")
    hand.slots = 0
    stage.worker(run=None, any=True)
    hand.ready()
    other = stage.also(hand, run="two")
    hand.vanish()
    hand.slots = 1  # as if another worker served it; the next run has no slots
    other.ready()
    other.send(1, other.job())
    assert other.result(other.job()).fitness is not None
    assert not [line for line in drained(said) if "starting another" in line]


@pytest.mark.slow
def test_without_a_flag_it_says_why_its_run_ended_and_waits_for_it(stage, said, cached):
    hand, _, served = stage.served(tasks.SLOW_TOY)
    hand.answer_no_hello()  # as a run that has ended
    hand.send(0, vectors=(), ended=True, why="2 generations")
    assert hand.beat(lambda beat: beat.reason).reason.endswith("2 generations")
    hand.vanish()
    wait_for(said, hand.endpoint)
    stage.also(hand, tasks.SLOW_TOY).ready()
    assert not served.done()


@pytest.mark.slow
def test_a_worker_that_served_to_the_end_says_so_however_long_its_exit_takes():
    lingers = "import atexit, sys, time; atexit.register(time.sleep, 3600); from dreamfleet.__main__ import main; "
    words = ("worker", "--connect", f"tcp/127.0.0.1:{free_port()}", "--lifetime", "0.1")
    ended = subprocess.run([sys.executable, "-c", lingers + "sys.exit(main())", *words], check=False, timeout=DEADLINE)
    assert ended.returncode == 0
