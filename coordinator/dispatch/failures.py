"""Failures of jobs, attempt by attempt, and the pause before the next one. Pure."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.failures import Failure, describe_job
from dreamfleet.coordinator.jobs.work import Work

LONGEST_ERROR = 300  # characters of a worker's error that are shown
MAX_NAMED = 4  # workers that a failure names
LONGEST_PAUSE = 120.0  # seconds between two attempts
WORKER_ENDED = Failure.of_host("its worker was lost")


def host_of(worker: str) -> str:
    """A worker's name without its life: attempts on one host are less independent than on two."""
    return worker.partition("/")[0]


@dataclass(frozen=True)
class Attempt:
    """One failed attempt: on which worker, and the error that it sent."""

    worker: str
    error: Failure

    @property
    def host(self) -> str:
        """The name of its host."""
        return host_of(self.worker)


@dataclass(frozen=True)
class JobFailure:
    """A wanted job that failed on some workers, attempt by attempt."""

    work: Work
    history: tuple[Attempt, ...]
    retry_at: float = 0.0  # seconds of the monotonic clock before which it is not tried again; 0: it waits for a slot

    @property
    def errors(self) -> dict[str, str]:
        """The last error of each worker, in words."""
        return {each.worker: each.error.text for each in self.history}

    @property
    def is_loss(self) -> bool:
        """Whether each attempt ended with its worker, without a word of why."""
        return all(each.error == WORKER_ENDED for each in self.history)

    @property
    def attempts(self) -> dict[str, int]:
        """How often it failed on each worker."""
        return dict(Counter(each.worker for each in self.history))

    @property
    def subject(self) -> str:
        """What the job scores, in words."""
        job = self.work.job
        return f"{describe_job(job.kind, job.generation, job.candidate, job.seeds)},"

    def __str__(self) -> str:
        """One sentence for people: what failed, on which workers, how often, and why."""
        errors, attempts = self.errors, self.attempts
        names = list(errors)
        number = "two" if len(names) == 2 else str(len(names))
        where = "on one worker" if len(names) == 1 else f"on {number} workers"
        parts = [f"{name} ({_times(attempts[name])}): {shorten(errors[name])}" for name in names[:MAX_NAMED]]
        more = [f"and {len(names) - MAX_NAMED} more"] if len(names) > MAX_NAMED else []
        return f"{self.subject} failed {where}: {'; '.join(parts + more)}"


def pause_before_retry(attempts: int) -> float:
    """Seconds before the next attempt: none after the first, then 1, 2, 4 up to two minutes.

    Two quick attempts on two hosts settle most failures. The later ones wait for memory or disk to come back.
    """
    return 0.0 if attempts < 2 else min(2.0 ** min(attempts - 2, 10), LONGEST_PAUSE)


def shorten(error: str, longest: int = LONGEST_ERROR) -> str:
    """An error's text, cut to what a line can hold."""
    return truncate(error, longest)  # it came over the wire


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
