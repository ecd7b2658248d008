"""What failed attempts prove. Tests failure_judge.py."""

import pytest

from dreamfleet.common.protocol.failures import Failure
from dreamfleet.coordinator.dispatch.failure_judge import is_lasting
from dreamfleet.coordinator.dispatch.failures import LONGEST_PAUSE, Attempt, pause_before_retry
from tests.support.failures import failure

A, B, OTHER_A = "a/00000001", "b/00000001", "a/00000002"
WORKS = {"a", "b"}  # hosts that have scored
SHORTAGE = Failure.of_host("killed by SIGKILL")


def attempts(*rows):
    return [Attempt(worker, error) for worker, error in rows]


@pytest.mark.parametrize(
    ("rows", "untried", "lasting"),
    [
        ([(A, failure("NaN score"))], True, False),
        ([(A, failure("NaN score"))], False, False),
        ([(A, failure("ValueError", "at 0x1")), (B, failure("ValueError", "at 0x2"))], True, True),
        ([(A, failure("ValueError", "1")), (A, failure("ValueError", "2"))], False, True),
        ([(A, failure("ValueError", "1")), (OTHER_A, failure("ValueError", "2"))], True, False),
        ([(A, failure("ValueError", "1")), (B, failure("KeyError", "2"))], False, False),
        (
            [(A, failure("ValueError", "1")), (B, failure("KeyError", "2")), (A, failure("IndexError", "3"))],
            False,
            True,
        ),
        ([(A, SHORTAGE), (B, SHORTAGE)], False, False),
        ([(A, SHORTAGE)] * 9, False, False),
        ([(A, SHORTAGE)] * 10, False, True),
        ([(A, failure("ObjectiveError", "cost returned nan"))], False, False),
        ([(A, SHORTAGE), (B, failure("NaN score")), (A, SHORTAGE), (A, failure("NaN score"))], False, True),
    ],
)
def test_two_equal_failures_on_two_hosts_where_there_are_two_show_that_the_episode_fails(rows, untried, lasting):
    assert is_lasting(attempts(*rows), WORKS, {"c"} if untried else ()) is lasting


def test_a_host_that_has_scored_nothing_proves_nothing():
    rows = [("new/1", failure("ImportError", "libGL")), ("newer/1", failure("ImportError", "libGL"))]
    assert not is_lasting(attempts(*rows * 9), WORKS, ())
    assert not is_lasting(attempts(*rows, (A, failure("ImportError", "libGL"))), WORKS, ())


def test_attempts_wait_longer_and_longer():
    assert [pause_before_retry(count) for count in range(5)] == [0.0, 0.0, 1.0, 2.0, 4.0]
    assert pause_before_retry(10**6) == LONGEST_PAUSE
