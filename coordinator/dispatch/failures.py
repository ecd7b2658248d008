"""Failures of jobs, and what they prove: a broken host, or an episode that fails wherever it is scored. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.failures import failure_cause, is_host_failure
from dreamfleet.coordinator.jobs.work import Work

LONGEST_ERROR = 300  # characters of a worker's error that are shown
MAX_NAMED = 4  # workers that a failure names
EQUAL_ATTEMPTS = 2  # that fail for one cause show that the episode fails
ANY_ATTEMPTS = 3  # that fail for several causes show it too
HOST_ATTEMPTS = 10  # that a host's shortage ends, over about eight minutes: no host has what the episode needs
LONGEST_PAUSE = 120.0  # seconds between two attempts


def host_of(worker: str) -> str:
    """A worker's name without its life: attempts on one host are less independent than on two."""
    return worker.partition("/")[0]


@dataclass(frozen=True)
class Attempt:
    """One failed attempt: on which worker, and the error that it sent."""

    worker: str
    error: str

    @property
    def host(self) -> str:
        """The name of its host."""
        return host_of(self.worker)


@dataclass(frozen=True)
class JobFailure:
    """A wanted job that failed on some workers, attempt by attempt."""

    work: Work
    history: tuple[Attempt, ...]

    @property
    def errors(self) -> dict[str, str]:
        """The last error of each worker."""
        return {each.worker: each.error for each in self.history}

    @property
    def attempts(self) -> dict[str, int]:
        """How often it failed on each worker."""
        return dict(Counter(each.worker for each in self.history))

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
        """One sentence for people: what failed, on which workers, how often, and why."""
        errors, attempts = self.errors, self.attempts
        names = list(errors)
        number = "two" if len(names) == 2 else str(len(names))
        where = "on one worker" if len(names) == 1 else f"on {number} workers"
        parts = [f"{name} ({_times(attempts[name])}): {shorten(errors[name])}" for name in names[:MAX_NAMED]]
        more = [f"and {len(names) - MAX_NAMED} more"] if len(names) > MAX_NAMED else []
        return f"{self.subject} failed {where}: {'; '.join(parts + more)}"


def is_lasting(attempts: Sequence[Attempt], working: Collection[str], untried_hosts: bool) -> bool:
    """Whether the failure follows from the parameters and the seed, so that every host would fail.

    R8: it takes two attempts with one cause, or three with any, on hosts that have scored jobs of this run (`working`,
    by name), and on two hosts where there is a second one (`untried_hosts`: some host has not tried it yet). A
    shortage of the host (memory, disk, processes) counts only after ten attempts.
    """
    able = [each for each in attempts if each.host in working]
    own = [each for each in able if not is_host_failure(each.error)]
    if len(able) - len(own) >= HOST_ATTEMPTS:
        return True
    if untried_hosts and len({each.host for each in own}) < 2:
        return False
    most = max(Counter(failure_cause(each.error) for each in own).values(), default=0)
    return most >= EQUAL_ATTEMPTS or len(own) >= ANY_ATTEMPTS


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
