"""Failures while scoring: one of them as data, and which of them have been logged. Pure."""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from dataclasses import dataclass

from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.failures import Failure, describe_job
from dreamfleet.common.protocol.messages import Job
from dreamfleet.worker.scoring.failure_cause import encodable, failure_of

MAX_TRACE = 8000  # characters of a traceback that are kept, from its end, where the cause stands
MAX_KINDS = 100  # kinds of failures that are logged at most


@dataclass(frozen=True)
class ScoringFailure:
    """An exception that was raised while scoring.

    `trace` is the traceback. `kind` is the exception's type and the line of code that raised it, so
    two failures with different numbers in their texts have the same kind.
    """

    error: Failure
    kind: str
    trace: str

    @classmethod
    def of(cls, error: BaseException) -> ScoringFailure:
        """From a caught exception."""
        try:
            places = traceback.extract_tb(error.__traceback__)
            trace = "".join(traceback.format_exception(error)).rstrip()
        except Exception:  # a simulator's exceptions may fail in every way
            places, trace = traceback.StackSummary(), "its traceback cannot be formatted"
        place = f"{places[-1].filename}:{places[-1].lineno}" if places else "nowhere"
        kind = encodable(f"{type(error).__name__} at {place}")
        return cls(failure_of(error), kind, encodable(trace[-MAX_TRACE:]))


class FailureLog:
    """Decides which failures are logged.

    A broken task fails in every job of every candidate. One traceback suffices; each result still carries its error.
    """

    def __init__(self) -> None:
        self._logged_kinds: set[str] = set()

    def format_if_new(self, failure: ScoringFailure, task: str, jobs: Sequence[Job]) -> str | None:
        """The log text of a failure in `jobs` (none: as a slot started); `None` if its kind was logged before.

        R26: the log must not grow with the run, so the number of logged kinds is limited too.
        """
        if failure.kind in self._logged_kinds or len(self._logged_kinds) >= MAX_KINDS:
            return None
        self._logged_kinds.add(failure.kind)
        return (
            f"task {task}: {failure.error.text}{describe_jobs(jobs) or ' as a slot started'}; later failures from this "
            f"line are not logged\n{failure.trace}"
        ).rstrip()


def describe_jobs(jobs: Sequence[Job]) -> str:
    """Which jobs failed, in words; empty: none was scored."""
    if not jobs:
        return ""
    first, more = jobs[0], f", and {plural(len(jobs) - 1, 'job')} scored with it" if len(jobs) > 1 else ""
    return f" at {describe_job(first.kind, first.generation, first.candidate, first.seeds)}{more}"
