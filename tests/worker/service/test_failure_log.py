import re
from pathlib import Path

from dreamfleet.worker.service.failure_log import MAX_KINDS, MAX_TRACE, FailureLog, ScoringFailure
from tests.support.failures import failure
from tests.support.samples import job


def raised(error, depth=0):
    try:
        if depth:
            raise_deeper(error, depth)
        raise error
    except Exception as caught:
        return ScoringFailure.of(caught)


def raise_deeper(error, depth):
    if depth:
        raise_deeper(error, depth - 1)
    raise error


def test_a_failure_is_logged_with_its_task_its_job_and_its_traceback():
    logged = FailureLog().format_if_new(raised(RuntimeError("the road has ended")), "moon", [job()])
    first, *trace = logged.splitlines()
    assert re.search("moon.*RuntimeError: the road has ended .*candidate 7/2, seed 1048576", first)
    assert "Traceback" in trace[0]
    assert trace[-1] == "RuntimeError: the road has ended"


def test_each_kind_is_logged_once():
    failures = FailureLog()
    assert failures.format_if_new(raised(ValueError("lap 1")), "moon", [job()])
    assert failures.format_if_new(raised(ValueError("lap 2")), "moon", [job(1)]) is None
    assert failures.format_if_new(raised(KeyError("lap 2")), "moon", [job(1)]), "another error of the same line"
    assert failures.format_if_new(raised(ValueError("lap 2"), depth=1), "moon", [job(1)]), (
        "the same error of another line"
    )


def test_the_first_of_several_jobs_is_named_and_the_others_are_counted():
    logged = FailureLog().format_if_new(raised(ValueError("lap 1")), "moon", [job(), job(1), job(2)])
    assert re.search(r"seed 1048576.* 2\b", logged)
    assert "seed" not in FailureLog().format_if_new(raised(ValueError("lap 1")), "moon", []).splitlines()[0]


def test_the_log_is_bounded():
    failures = FailureLog()
    logged = [
        failures.format_if_new(ScoringFailure(failure("text"), str(kind), "trace"), "moon", [])
        for kind in range(2 * MAX_KINDS)
    ]
    assert sum(text is not None for text in logged) == MAX_KINDS
    assert len(raised(RuntimeError("x" * 100_000)).trace) == MAX_TRACE


def test_an_error_that_cannot_be_encoded_is_replaced():
    failure = raised(OSError("no file \udcff\nsecond line"))
    assert failure.error.text == r"OSError: no file \udcff"
    assert failure.trace.encode()
    assert raised(RuntimeError("")).error.text.startswith(f"RuntimeError: {Path(__file__).name}:")
