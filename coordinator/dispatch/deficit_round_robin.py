"""What evaluations and kept rollouts get of a busy fleet: a share of its slots' time. Pure.

Counted in the slots' seconds, as results tell them, not in jobs: an evaluation is a whole episode, which may take a
hundred times as long as a dreamt one. A deficit counter (Shreedhar and Varghese 1995): each second that a slot worked
earns `share` of a second, and a job that went by its share costs its seconds.
"""

from __future__ import annotations

SMOOTHING = 0.1  # weight of the newest job in the typical one
OUTLIER = 10  # times the typical: more is a suspended host's or a confused clock's, and no job's


class DeficitCounter:
    """Says when a job that else waits for idle slots goes before what is scored."""

    def __init__(self, share: float) -> None:
        self.share = share
        self._earned = 0.0  # seconds; below zero: owed
        self._typical_seconds: dict[bool, float] = {}  # seconds of a job, by whether it is of those that wait
        self._outstanding: set[bytes] = set()  # jobs that went by their share and have not come back

    def is_due(self, slots: int) -> bool:
        """Whether one more job may go now: what those in workers' hands should take is set aside.

        Its share of so many slots is lent at once, so that a large fleet does not wait for the first to come back.
        """
        if not self.share:
            return False
        typical = self._typical_seconds.get(True, 0.0)
        return self._earned + self.share * slots * typical >= self._reserved if typical else not self._outstanding

    def reserve(self, digest: bytes) -> None:
        """A job goes by its share."""
        self._outstanding.add(digest)

    def release(self, digest: bytes) -> None:
        """A job that went comes back undone."""
        self._outstanding.discard(digest)

    def charge(self, digest: bytes, seconds: float, *, is_background: bool, waiting: bool) -> None:
        """A job was done in so many of a slot's seconds; `waiting`: there are others that wait for their share.

        While none waits, nothing is saved up: a later evaluation must not stop the fleet.
        """
        typical = self._typical_seconds.get(is_background)
        if typical:
            seconds = min(seconds, OUTLIER * typical)
        self._typical_seconds[is_background] = seconds if not typical else typical + SMOOTHING * (seconds - typical)
        self._earned += self.share * seconds
        if digest in self._outstanding:
            self._outstanding.discard(digest)
            self._earned -= seconds
        if not waiting:
            self._earned = min(self._earned, self._reserved)

    @property
    def _reserved(self) -> float:
        return len(self._outstanding) * self._typical_seconds.get(True, 0.0)
