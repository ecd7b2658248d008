"""Which failures have been told. Pure: failures in, what to log out.

A broken task fails in every job of every candidate. Its traceback is told once; each result still carries its error.
"""

from __future__ import annotations

from collections.abc import Sequence

from dreamfleet.common.protocol.messages import Job
from dreamfleet.worker.service.job_group import ScoringFailure

MOST_KINDS = 100  # after which nothing is told any more: no log should grow with a run


class FailureLog:
    """Tells each kind of failure once."""

    def __init__(self) -> None:
        self._logged_kinds: set[str] = set()

    def format_if_new(self, failure: ScoringFailure, task: str, jobs: Sequence[Job]) -> str | None:
        """What to log of a failure in these jobs, or of a slot's start where there are none; `None`: told before."""
        if failure.kind in self._logged_kinds or len(self._logged_kinds) >= MOST_KINDS:
            return None
        self._logged_kinds.add(failure.kind)
        return (
            f"task {task}: {failure.text} ({_describe_jobs(jobs)}); later failures from this line are not logged\n"
            + (failure.trace)
        )


def _describe_jobs(jobs: Sequence[Job]) -> str:
    if not jobs:
        return "as a slot started"
    job = jobs[0]
    more = f", or one of {len(jobs) - 1} jobs scored with it" if len(jobs) > 1 else ""
    return f"{job.kind} in generation {job.generation}, candidate {job.candidate}, seed {job.seeds[0]}{more}"
