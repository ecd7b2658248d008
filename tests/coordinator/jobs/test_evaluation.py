import numpy as np
import pytest

from dreamfleet.common.runs.records import StoredEvaluation
from dreamfleet.coordinator.jobs.evaluation import Evaluation, Evaluations
from tests.support.samples import SPEC


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
    assert Evaluations(evaluations(*means)).have_fallen_behind(count) == expected


def test_evaluations_of_one_mean_share_their_scores_whichever_is_asked_first():
    """A run that has converged evaluates the same vector again."""
    evaluations, vector = Evaluations(), np.zeros(4, np.float32).tobytes()
    first = evaluations.open(Evaluation(2, vector, 3), SPEC, {})
    assert len(first) == 3
    assert evaluations.open(Evaluation(5, vector, 3), SPEC, {}) == []
    for number, work in enumerate(first):
        assert evaluations.record(work.job.digest, float(number)) == [2, 5]
    finished = [evaluations.finish(generation).found for generation in (2, 5)]
    assert [each.mean for each in finished] == [1.0, 1.0]
    known = {work.job.digest: 4.0 for work in first}
    assert evaluations.open(Evaluation(8, vector, 3), SPEC, known) == []
    assert evaluations.finish(8).found.mean == 4.0
