"""What failed attempts prove. Tests failure_judge.py."""

import pytest

from dreamfleet.coordinator.dispatch.failure_judge import is_lasting
from dreamfleet.coordinator.dispatch.failures import LONGEST_PAUSE, Attempt, pause_before_retry

A, B, OTHER_A = "a/00000001", "b/00000001", "a/00000002"
WORKS = {"a", "b"}  # hosts that have scored
SHORTAGE = "host: killed by SIGKILL"


def attempts(*rows):
    return [Attempt(worker, error) for worker, error in rows]


@pytest.mark.parametrize(
    ("rows", "untried", "lasting"),
    [
        ([(A, "NaN score")], True, False),
        ([(A, "NaN score")], False, False),
        ([(A, "ValueError: at 0x1"), (B, "ValueError: at 0x2")], True, True),
        ([(A, "ValueError: 1"), (A, "ValueError: 2")], False, True),
        ([(A, "ValueError: 1"), (OTHER_A, "ValueError: 2")], True, False),
        ([(A, "ValueError: 1"), (B, "KeyError: 2")], False, False),
        ([(A, "ValueError: 1"), (B, "KeyError: 2"), (A, "IndexError: 3")], False, True),
        ([(A, SHORTAGE), (B, SHORTAGE)], False, False),
        ([(A, SHORTAGE)] * 9, False, False),
        ([(A, SHORTAGE)] * 10, False, True),
        ([(A, "ObjectiveError: cost returned nan")], False, False),
        ([(A, SHORTAGE), (B, "NaN score"), (A, SHORTAGE), (A, "NaN score")], False, True),
    ],
)
def test_two_equal_failures_on_two_hosts_where_there_are_two_show_that_the_episode_fails(rows, untried, lasting):
    assert is_lasting(attempts(*rows), WORKS, {"c"} if untried else ()) is lasting


def test_a_host_that_has_scored_nothing_proves_nothing():
    rows = [("new/1", "ImportError: libGL"), ("newer/1", "ImportError: libGL")]
    assert not is_lasting(attempts(*rows * 9), WORKS, ())
    assert not is_lasting(attempts(*rows, (A, "ImportError: libGL")), WORKS, ())


def test_attempts_wait_longer_and_longer():
    assert [pause_before_retry(count) for count in range(5)] == [0.0, 0.0, 1.0, 2.0, 4.0]
    assert pause_before_retry(10**6) == LONGEST_PAUSE
