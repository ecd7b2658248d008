"""One failed attempt at a job, and the pause before the next one. Pure."""

from dataclasses import dataclass

from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.keys import host_of

LONGEST_ERROR = 300  # characters of a worker's error that are shown
LONGEST_PAUSE = 120.0  # seconds between two attempts; HOST_ATTEMPTS in failure_judge.py reckons with it
WORKER_ENDED = Failure.of_host("its worker was lost")


@dataclass(frozen=True)
class Attempt:
    """One failed attempt: on which worker, and the error that it sent."""

    worker: str
    error: Failure

    @property
    def host(self) -> str:
        """The name of its host: attempts on one are less independent than on two."""
        return host_of(self.worker)


def pause_before_retry(attempts: int) -> float:
    """Seconds before the next attempt: none after the first, then 1, 2, 4 up to two minutes.

    Two quick attempts on two hosts settle most failures. The later ones wait for memory or disk to come back.
    """
    return 0.0 if attempts < 2 else min(2.0 ** min(attempts - 2, 10), LONGEST_PAUSE)
