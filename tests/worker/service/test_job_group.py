"""Scoring a group of jobs, without a child process, and what is logged of failures. Tests failure_log.py."""

import re
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from dreamfleet.worker.service.failure_log import MAX_KINDS, MAX_TRACE, FailureLog, ScoringFailure
from dreamfleet.worker.service.job_group import AbandonedError, score_group
from dreamfleet.worker.tasks.api import Score
from tests.support.failures import failure
from tests.support.rough_tasks import ERRORS
from tests.support.samples import SPEC, VECTOR, job

WORK = [(job(number), VECTOR) for number in range(3)]


class Scorer:
    def __init__(self, *scores):
        self._scores = scores

    spec = SPEC

    def score_all(self, episodes, on_step, spec):
        assert all(np.array_equal(vector, np.frombuffer(VECTOR, "<f4")) for _, vector, _ in episodes)
        assert spec == SPEC
        for number, _ in enumerate(self._scores):
            on_step(number + 1)
        return list(self._scores)


def score(*scores, count=lambda _made: None):
    return score_group(Scorer(*scores), 5, WORK, count)


def test_each_job_has_its_own_result_in_plain_numbers_and_an_equal_share_of_the_time():
    done = score(*(Score(np.float32(number), np.int64(10 + number)) for number in range(3)))
    assert (done.group, done.upload, done.failure) == (5, None, None)
    assert [(each.digest, each.fitness, each.steps) for each in done.results] == [
        (job(number).digest, float(number), 10 + number) for number in range(3)
    ]
    assert {(type(each.fitness), type(each.steps)) for each in done.results} == {(float, int)}
    assert len({each.seconds for each in done.results}) == 1


@pytest.mark.parametrize(
    ("scores", "said"), [([Score(1.0, 1)], "1 score of 3 episodes"), ([Score(1.0, 1)] * 2 + [None], "AttributeError")]
)
def test_invalid_scores_are_the_tasks_error(scores, said):
    done = score(*scores)
    assert [each.fitness for each in done.results] == [None] * 3
    assert all(said in each.error.text for each in done.results)
    assert said in done.failure.trace


@pytest.mark.parametrize("number", [float("nan"), float("inf"), 1e300])
def test_a_fitness_that_is_no_number_is_the_error_of_its_job_alone(number):
    done = score(Score(1.0, 1), Score(number, 1), Score(2.0, 1))
    assert [each.fitness for each in done.results] == [1.0, None, 2.0]
    assert done.results[1].error is not None
    assert done.failure is None


def test_an_abandoned_group_has_no_results_and_no_failure():
    def count(made):
        if made == 2:
            raise AbandonedError

    done = score(*[Score(1.0, 1)] * 3, count=count)
    assert (done.results, done.failure) == ((), None)


@pytest.mark.parametrize("error", ERRORS)
def test_whatever_is_raised_is_each_jobs_error_and_the_steps_before_it_are_divided(error):
    class Failing(Scorer):
        def score_all(self, episodes, on_step, spec):
            on_step(9)
            raise ERRORS[error]()

    done = score_group(Failing(), 5, WORK, lambda _made: None)
    assert [each.steps for each in done.results] == [3, 3, 3]
    cause_and_kind = ("host", "host") if error in ("MemoryError", "OSError") else (error, "other")
    assert (done.failure.error.cause, done.failure.error.kind) == cause_and_kind
    assert error in done.failure.error.text
    assert "\n" not in done.failure.error.text
    assert done.results == tuple(replace(each, error=done.failure.error) for each in done.results)


def raised(error, depth=0):
    """The failure of an error that is raised in this line, or, with a depth, in the one above."""
    try:
        if depth:
            raise error
        raise error
    except Exception as caught:
        return ScoringFailure.of(caught)


def test_a_failure_is_logged_with_its_task_its_first_job_and_its_traceback():
    found = raised(RuntimeError("the road has ended"))
    logged = [FailureLog().format_if_new(found, "moon", [job(row) for row in range(jobs)]) for jobs in range(4)]
    first, *trace = logged[1].splitlines()
    assert re.search("moon.*RuntimeError: the road has ended .*candidate 7/2, seed 1048576", first)
    assert "Traceback" in trace[0]
    assert trace[-1] == "RuntimeError: the road has ended"
    assert re.search(r"seed 1048576.* 2\b", logged[3])
    assert "seed" not in logged[0].splitlines()[0]


def test_each_kind_is_logged_once():
    failures = FailureLog()
    cases = (ValueError("lap 1"), 0, True), (ValueError("lap 2"), 0, False), (KeyError("1"), 0, True)
    for error, depth, is_new in (*cases, (ValueError("lap 2"), 1, True)):
        assert bool(failures.format_if_new(raised(error, depth), "moon", [job()])) == is_new


def test_the_log_is_bounded():
    failures = FailureLog()
    kinds = [ScoringFailure(failure("text"), str(kind), "trace") for kind in range(2 * MAX_KINDS)]
    assert sum(failures.format_if_new(kind, "moon", []) is not None for kind in kinds) == MAX_KINDS
    assert len(raised(RuntimeError("x" * 100_000)).trace) == MAX_TRACE


def test_an_error_that_cannot_be_encoded_is_replaced():
    failure = raised(OSError("no file \udcff\nsecond line"))
    assert failure.error.text == r"OSError: no file \udcff"
    assert failure.trace.encode()
    assert raised(RuntimeError("")).error.text.startswith(f"RuntimeError: {Path(__file__).name}:")
