"""Which failures have been told. Pure: failures in, what to log out.

A broken task fails in every job of every candidate. Its traceback is told once; each result still carries its error.
"""

from __future__ import annotations

from collections.abc import Sequence

from dreamfleet.common.messages import Job
from dreamfleet.worker.service.turn import Failure

MOST_KINDS = 100  # after which nothing is told any more: no log should grow with a run


class Failures:
    """Tells each kind of failure once."""

    def __init__(self) -> None:
        self._told: set[str] = set()

    def tell(self, failure: Failure, task: str, jobs: Sequence[Job]) -> str | None:
        """What to log of a failure in these jobs, or of a slot's start where there are none; `None`: told before."""
        if failure.kind in self._told or len(self._told) >= MOST_KINDS:
            return None
        self._told.add(failure.kind)
        return f"task {task}: {failure.text} ({_where(jobs)}); later failures from this line are not logged\n" + (
            failure.trace
        )


def _where(jobs: Sequence[Job]) -> str:
    if not jobs:
        return "as a slot started"
    job = jobs[0]
    more = f", or one of {len(jobs) - 1} jobs scored with it" if len(jobs) > 1 else ""
    return f"{job.kind} in generation {job.generation}, candidate {job.candidate}, seed {job.seeds[0]}{more}"
