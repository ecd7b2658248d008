import numpy as np
import pytest

from dreamfleet.common.runs.paired_difference import is_clearly_below
from dreamfleet.common.runs.records import StoredEvaluation
from dreamfleet.coordinator.jobs.evaluation import Evaluation, Evaluations
from tests.support.samples import SPEC

TRACKS = np.random.default_rng(1).normal(0, 200, 16)  # what each track adds to every mean's score


def evaluated(*means, missing=()):
    """Evaluations that differ by track as controllers do: by `TRACKS`, and by a little noise; and their scores."""
    noise = np.random.default_rng(2).normal(0, 10, (len(means), 16))
    scores = {
        generation: {
            seed: float(mean + TRACKS[seed] + noise[generation, seed])
            for seed in range(16)
            if (generation, seed) not in missing
        }
        for generation, mean in enumerate(means)
    }
    rows = [StoredEvaluation(generation, 16, mean, 200.0) for generation, mean in enumerate(means)]
    return Evaluations(rows), scores.__getitem__


@pytest.mark.parametrize(
    ("means", "count", "expected"),
    [
        ((), 1, False),
        ((500.0,), 1, False),
        ((500.0, 499.0), 1, False),
        ((500.0, 475.0), 1, True),
        ((500.0, 475.0), 2, False),
        ((500.0, 475.0, 499.0), 2, False),
        ((500.0, 475.0, 480.0), 2, True),
        ((300.0, 500.0, 475.0, 480.0), 2, True),
        ((100.0, 300.0, 500.0), 2, False),
    ],
)
def test_dream_and_reality_have_parted_when_the_last_means_lie_clearly_below_the_best(means, count, expected):
    """Here by half the error of a mean: the tracks' differences cancel, for all evaluations have the same tracks."""
    found, find_scores = evaluated(*means)
    assert found.have_fallen_behind(count, find_scores) == expected


def test_evaluations_are_compared_on_the_tracks_that_both_have_scores_of():
    """Without the hardest tracks of the one and the easiest of the other, means alone would say the opposite."""
    hard, easy = np.argsort(TRACKS)[:6], np.argsort(TRACKS)[-6:]
    found, find_scores = evaluated(500.0, 400.0, missing={(0, each) for each in easy} | {(1, each) for each in hard})
    assert np.mean(list(find_scores(1).values())) > np.mean(list(find_scores(0).values()))
    assert found.have_fallen_behind(1, find_scores)


def test_fewer_than_two_common_tracks_show_nothing_and_two_take_students_t():
    """With two tracks, four standard errors are no finding: t is 14 at the probability of two of many."""
    assert not is_clearly_below({}, {})
    assert not is_clearly_below({1: -900.0}, {1: 900.0, 2: 900.0})
    assert not is_clearly_below({1: 100.0, 2: 160.0}, {1: 250.0, 2: 250.0})
    assert is_clearly_below({1: 100.0, 2: 104.0}, {1: 250.0, 2: 250.0})
    assert not is_clearly_below({1: 250.0, 2: 250.0}, {1: 100.0, 2: 104.0}), "above"


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
    assert Evaluations([*evaluations.rows, StoredEvaluation(6, 2, 9.0, 0.0, failed=1)]).best.generation == 2
    known = {work.job.digest: 4.0 for work in first}
    assert evaluations.open(Evaluation(8, vector, 3), SPEC, known) == []
    assert evaluations.finish(8).found.mean == 4.0
