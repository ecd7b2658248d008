import re
from pathlib import Path

from dreamfleet.worker.service.failure_log import MAX_KINDS, MAX_TRACE, FailureLog, ScoringFailure
from tests.support.failures import failure
from tests.support.samples import job


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
