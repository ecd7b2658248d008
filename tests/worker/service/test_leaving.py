"""When and how a worker leaves."""

import pytest

from dreamfleet.worker.service import membership
from tests.support import tasks
from tests.support.hand import DEADLINE
from tests.support.stage import drained, wait_for


@pytest.mark.parametrize("when", ["before it joined", "afterwards"])
def test_with_exit_when_done_it_leaves_when_its_run_is_over(stage, cached, monkeypatch, when):
    monkeypatch.setattr(membership, "COORDINATOR_GONE_AFTER", 0.3)
    hand = stage.hand()
    if when == "before it joined":
        hand.vanish()
    _, served = stage.worker(exit_when_done=True)
    hand.hello()
    if when == "afterwards":
        hand.beat(lambda beat: beat.capacity > 0)
        hand.vanish()
    assert served.result(DEADLINE) is None


def test_stopped_once_it_finishes_running_jobs_and_delivers(stage, cached):
    hand = stage.hand(tasks.SLOW_TOY)
    made, served = stage.worker()
    hand.ready()
    running, queued = hand.job(0), hand.job(1)
    hand.send(1, running, queued)
    hand.beat(lambda beat: beat.running)
    made.stop()
    assert hand.beat(lambda beat: beat.capacity == 0).queued == ()
    assert hand.result(running).fitness is not None
    assert not served.done()
    hand.send(2, accepted=(running,))
    assert served.result(DEADLINE) is None


def test_stopped_twice_it_abandons_running_jobs(stage, said, cached):
    hand = stage.hand(tasks.SLOW_TOY)
    made, served = stage.worker()
    hand.ready()
    hand.send(1, hand.job())
    hand.beat(lambda beat: beat.running)
    made.stop()
    made.stop()
    assert served.result(DEADLINE) is None
    wait_for(said, ": 0 jobs")


def test_stopped_once_it_abandons_a_download(stage):
    hand = stage.hand()
    hand.damage = lambda offset, data: None
    made, served = stage.worker()
    hand.offsets.get(timeout=DEADLINE)
    made.stop()
    assert served.result(2) is None


def test_jobs_that_arrive_while_it_drains_go_back(stage, cached):
    hand = stage.hand(tasks.SLOW_TOY)
    made, _ = stage.worker()
    hand.ready()
    running, late = hand.job(0), hand.job(1)
    hand.send(1, running)
    hand.beat(lambda beat: beat.running)
    made.stop()
    hand.beat(lambda beat: beat.capacity == 0)
    hand.send(2, late)
    assert hand.beat(lambda beat: beat.seen == 2).queued == ()


@pytest.mark.parametrize("coordinator", [False, True])
def test_its_lifetime_ends_without_a_run_too(stage, coordinator):
    if coordinator:
        stage.hand(run="another")
    _, served = stage.worker(lifetime=0.5)
    assert served.result(DEADLINE) is None


def test_late_events_of_the_last_runs_slots_do_not_reach_the_next_run(stage, said, cached, monkeypatch):
    monkeypatch.setattr(membership, "COORDINATOR_GONE_AFTER", 0.3)
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
