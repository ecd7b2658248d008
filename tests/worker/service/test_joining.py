"""How a worker comes to a run: it waits, is welcomed or refused."""

import pytest

from dreamfleet.common.errors import RefusedError, UsageError
from dreamfleet.common.fingerprint import NUMERIC_PACKAGES, fingerprint
from dreamfleet.common.messages import Intervals
from dreamfleet.common.session import Network
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.worker import Worker
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


def test_it_says_hello_again_about_the_packages_that_the_runs_fingerprint_names(stage, cached):
    hand = stage.hand()
    hand.packages = ("numpy", "no-such-package")
    stage.worker()
    first, second = hand.hello(), hand.hello()
    assert (first.packages, second.packages) == (NUMERIC_PACKAGES, hand.packages)
    assert "gymnasium" in first.fingerprint
    assert second.fingerprint == fingerprint(hand.packages)
    assert "gymnasium" not in second.fingerprint
    assert hand.beat(lambda beat: beat.capacity > 0).slots == 1


def test_a_refusal_ends_it_with_the_reason_and_the_remedy(stage):
    stage.hand().refusal = ("your moon is full", "wait a week")
    _, served = stage.worker()
    error = served.exception(DEADLINE)
    assert isinstance(error, RefusedError)
    assert "your moon is full; wait a week" in str(error)


def test_of_any_run_one_that_refuses_is_left_to_others(stage, said, cached):
    picky = stage.hand(run="picky")
    picky.refusal = ("your moon is full", "wait a week")
    other = stage.also(picky, run="second")
    other.slots = 1
    stage.worker(run=None, any=True)
    assert "your moon is full; wait a week; asking it again in 15 s" in wait_for(said, "refused")
    other.ready()


def test_a_name_is_what_the_run_knows_it_by(stage, cached):
    hand = stage.hand()
    stage.worker(name="hostB")
    assert hand.hello().worker.startswith("hostB/")


def test_a_name_that_cannot_be_kept_is_refused():
    with pytest.raises(UsageError, match="'big host' cannot name a worker"):
        WorkerConfig(name="big host")


def test_a_task_that_it_is_told_of_and_cannot_load_is_an_error_at_once():
    with pytest.raises(UsageError, match=r"'tests\.support\.tasks:Moon' cannot be loaded"):
        Worker(WorkerConfig(), Network(), ("tests.support.tasks:Moon",))
