"""A worker that serves several runs side by side. Tests worker.py, slot_budget.py and membership.py."""

import re
from concurrent.futures import wait

import pytest
from msgspec.structs import replace

from dreamfleet.worker.service.slot_pool import SlotPool
from tests.support import tasks
from tests.support.hand import DEADLINE
from tests.support.stage import drained, wait_for


@pytest.fixture
def both(stage, cached):
    """Two runs on one router, and a worker of one slot that serves both."""
    one = stage.hand(tasks.SLOW_TOY, run="one")
    two = stage.also(one, tasks.SLOW_TOY, run="two")
    one.answers = two.answers = True  # or it says hello again while its jobs wait for the other run's
    made, served = stage.worker(run=None, any=True)
    one.ready()
    two.ready()
    return one, two, made, served


def test_a_run_waits_for_budget_without_counting_as_hung(both, said):
    one, two, *_ = both
    job, other = replace(one.job(), stall=0.2), one.job(1)
    one.send(1, one.job(2), one.job(3))
    two.send(1, job, other)
    assert two.result(other).fitness is not None
    assert not [line for line in drained(said) if "starting another" in line]


def test_a_run_whose_coordinator_vanished_holds_up_no_other(both):
    one, two, *_ = both
    one.send(1, *(one.job(episode) for episode in range(2)))
    one.vanish()
    two.send(1, two.job())
    assert two.result(two.job()).fitness is not None


def test_a_run_that_answers_no_hello_holds_up_no_other(stage, cached):
    silent = stage.hand(run="one")
    good = stage.also(silent, run="two")
    silent.answer_no_hello()
    good.slots = 1  # so the silent one is asked first
    stage.worker(run=None, any=True)
    good.ready()


def test_no_more_than_runs_are_served_at_once(stage, said, cached):
    first = stage.hand(run="r0")
    second = stage.also(first, run="r1")
    stage.worker(run=None, any=True, runs=2)
    first.ready()
    second.ready()
    third = stage.also(first, run="r2")
    first.send(1, ended=True)
    first.leave()
    third.ready()
    named = re.findall(r"\br[012]\b", " ".join(drained(said)))
    assert "r0" not in named[named.index("r2") :], "it left the first before it joined the third"


def test_stopped_once_it_drains_every_run(both):
    one, two, made, served = both
    one.send(1, one.job())
    two.send(1, two.job())
    for hand in (one, two):
        hand.beat(lambda beat: beat.running or beat.queued)
    one.beat(lambda beat: beat.running or beat.unacked)
    made.stop()
    for hand in (one, two):
        hand.beat(lambda beat: beat.capacity == 0)
    one.result(one.job())
    one.send(2, accepted=(one.job(),))
    two.send(2, accepted=(two.job(),))
    assert served.result(DEADLINE) is None


def test_stopped_twice_it_leaves_every_run_at_once(both):
    one, _, made, served = both
    one.send(1, one.job())
    one.beat(lambda beat: beat.running)
    made.stop()
    made.stop()
    assert served.result(DEADLINE) is None


@pytest.mark.parametrize("runs", [4, 1])
def test_a_run_that_cannot_be_scored_ends_no_other(stage, said, cached, monkeypatch, runs):
    """One run's slots cannot start; the worker says why, asks that run later, and serves the other."""
    bad = stage.hand(tasks.SECOND_TOY, run="bad")
    good = stage.also(bad, run="good")
    good.slots = 1
    real = SlotPool.__init__

    def fails(self, share, arguments, *rest, **more):
        if arguments.spec.task == tasks.SECOND_TOY:
            raise OSError("no room on this device")
        real(self, share, arguments, *rest, **more)

    monkeypatch.setattr(SlotPool, "__init__", fails)
    _, served = stage.worker(run=None, any=True, runs=runs, announced=(*tasks.ALL, tasks.SECOND_TOY))
    wait_for(said, "no room on this device")
    good.ready()
    good.send(1, good.job())
    assert good.result(good.job()).fitness is not None
    assert not wait([served], timeout=0).done


@pytest.mark.slow
def test_children_start_as_jobs_need_them(stage, cached):
    one = stage.hand(tasks.HANGING, run="one")
    one.answers = True
    made, _ = stage.worker(run=None, any=True, slots=3, announced=(tasks.HANGING,))
    assert one.ready().capacity == 3
    (served,) = made._served
    assert sum(slot.parked for slot in served.session._slots._slots) == 2
    one.send(1, *(one.job(episode) for episode in range(3)))
    one.beat(lambda beat: len(beat.running) > 1)
