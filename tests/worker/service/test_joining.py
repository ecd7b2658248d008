"""How a worker comes to a run: it waits, is welcomed or refused."""

import pytest

from dreamfleet.common.errors import RefusedError, UsageError
from dreamfleet.common.messages import Intervals
from tests.support import tasks
from tests.support.hand import DEADLINE, Hand
from tests.support.processes import free_port
from tests.support.stage import wait_for

pytestmark = pytest.mark.timeout(60)
SLOW_BEATS = Intervals(beat=2 * DEADLINE, repeat=0.1)


def test_it_waits_for_a_coordinator_that_starts_later(stage, said, cached):
    stage.worker()
    wait_for(said, "waiting for a coordinator")
    assert stage.hand().ready().slots == 1


def test_a_slot_that_can_score_is_told_at_once(stage, cached):
    hand = stage.hand()
    hand.intervals = SLOW_BEATS
    stage.worker()
    hand.hello()
    assert [hand.beat().capacity, hand.beat().capacity] == [0, 1]


def test_it_waits_until_its_run_is_there(stage, said, cached):
    stage.hand(run="another")
    stage.worker()
    wait_for(said, "waiting for run test")


def test_without_a_name_it_joins_the_only_run(stage, cached):
    hand = stage.hand(run="night")
    stage.worker(run=None)
    assert hand.ready().slots == 1


def test_without_a_name_several_runs_are_listed(stage, cached):
    hand = stage.hand(run="night")
    other = Hand(free_port(), stage.bundle, tasks.TOY, run="day")
    answer = hand.session.declare_queryable("dreamfleet/hello/day", other._hello)
    _, served = stage.worker(run=None)
    assert isinstance(error := served.exception(DEADLINE), UsageError)
    assert "day, night" in str(error)
    answer.undeclare()
    other.close()


def test_a_refusal_ends_it_with_the_reason_and_the_remedy(stage):
    stage.hand().refusal = ("your moon is full", "wait a week")
    _, served = stage.worker()
    error = served.exception(DEADLINE)
    assert isinstance(error, RefusedError)
    assert "your moon is full; wait a week" in str(error)
