"""The share of a busy fleet's slot time that evaluations and kept rollouts get. Pure.

R18: background jobs get a fixed share, so an evaluation neither starves nor stops the fleet. The share is of seconds in
a slot, as results report them, not of jobs: an evaluation is a whole episode, which may take a hundred times as long as
a dreamt one. A deficit counter (Shreedhar and Varghese 1995): each second that a slot worked earns `share` of a second,
and a job that was given by its share costs its seconds.
"""

SMOOTHING = 0.1  # weight of the newest job in the typical duration
OUTLIER = 10  # times the typical duration: a longer one comes from a suspended host or a wrong clock


class DeficitCounter:
    """Decides when a background job goes before candidates' jobs."""

    def __init__(self, share: float) -> None:
        self.share = share
        self._earned = 0.0  # seconds; negative: a debt
        self._typical_seconds: dict[bool, float] = {}  # of a job, by whether it is a background job
        self._outstanding: set[bytes] = set()  # jobs that were given by their share and are not done

    def is_due(self, slots: int) -> bool:
        """Whether one more background job may be given now, beside what the outstanding ones will cost.

        The share of `slots` slots is lent at once, so that a large fleet need not wait for the first result.
        """
        if not self.share:
            return False
        typical = self._typical_seconds.get(True, 0.0)
        return self._earned + self.share * slots * typical >= self._reserved if typical else not self._outstanding

    def reserve(self, digest: bytes) -> None:
        """Note that a job is given by its share."""
        self._outstanding.add(digest)

    def release(self, digest: bytes) -> None:
        """Note that a job came back without a result."""
        self._outstanding.discard(digest)

    def charge(self, digest: bytes, seconds: float, *, is_background: bool, waiting: bool) -> None:
        """Note that a job took `seconds` of a slot; `waiting`: other background jobs are queued.

        While none is queued, unused time is not saved: a later evaluation must not stop the fleet.
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
