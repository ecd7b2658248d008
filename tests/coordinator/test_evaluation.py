import pytest

from dreamfleet.common.runs import StoredEvaluation
from dreamfleet.coordinator.evaluation import Evaluations


def evaluations(*means):
    return [StoredEvaluation(generation, 16, mean, 40.0) for generation, mean in enumerate(means)]  # standard error 10


@pytest.mark.parametrize(
    ("means", "count", "expected"),
    [
        ((), 1, False),
        ((500.0,), 1, False),
        ((500.0, 480.0), 1, False),
        ((500.0, 400.0), 1, True),
        ((500.0, 400.0), 2, False),
        ((500.0, 400.0, 490.0), 2, False),
        ((500.0, 400.0, 410.0), 2, True),
        ((300.0, 500.0, 400.0, 410.0), 2, True),
        ((100.0, 300.0, 500.0), 2, False),
    ],
)
def test_dream_and_reality_have_parted_when_the_last_means_lie_clearly_below_the_best(means, count, expected):
    assert Evaluations(evaluations(*means)).parted(count) == expected
