"""A job that gave no fitness, and where: what a paused run tells people."""

from __future__ import annotations

from dataclasses import dataclass

from dreamfleet.common.printable import truncate
from dreamfleet.coordinator.jobs.work import Work

LONGEST_ERROR = 300  # characters of a worker's error that are told
MOST_WORKERS = 4  # that are told by name


@dataclass(frozen=True)
class JobFailure:
    """A wanted job that failed on some workers: the last error of each, and how often it failed there."""

    work: Work
    errors: dict[str, str]  # worker -> error
    attempts: dict[str, int]  # worker -> how often

    @property
    def subject(self) -> str:
        """What the job scores, in words."""
        job = self.work.job
        words = {
            "score": f"candidate {job.generation}/{job.candidate}",
            "evaluate": f"the evaluation of generation {job.generation}'s mean",
            "collect": f"a kept rollout of generation {job.generation}'s mean",
        }
        return f"{words[job.kind]}, seed {', '.join(map(str, job.seeds))},"

    def __str__(self) -> str:
        """One sentence for people: what failed, on whom, how often, and why."""
        names = list(self.errors)
        where = "on one worker" if len(names) == 1 else f"on {_number(len(names))} workers"
        told = [
            f"{name} ({_times(self.attempts[name])}): {shorten(self.errors[name])}" for name in names[:MOST_WORKERS]
        ]
        more = [f"and {len(names) - MOST_WORKERS} more"] if len(names) > MOST_WORKERS else []
        return f"{self.subject} failed {where}: {'; '.join(told + more)}"


def shorten(error: str, longest: int = LONGEST_ERROR) -> str:
    """An error's text, cut to what a line can hold."""
    return truncate(error, longest)  # it came over the wire


def _number(count: int) -> str:
    return "two" if count == 2 else str(count)


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
