"""How long a generation could be scored. Pure: the time is an argument."""

from __future__ import annotations

LONGEST_TICK = 2.0  # seconds between ticks; a longer gap means that this process was suspended


class WorkClock:
    """Counts the seconds in which a run could work: it was not paused, and some worker was present."""

    def __init__(self, now: float, seconds: float = 0.0) -> None:
        """`now` is the monotonic clock's, `seconds` what earlier lives of the coordinator counted."""
        self.seconds = seconds
        self._last = now

    def tick(self, now: float, *, is_working: bool) -> None:
        """Count the time since the last tick, if the run could work."""
        if is_working:
            self.seconds += min(now - self._last, LONGEST_TICK)
        self._last = now

    def restart(self) -> None:
        """Count for the next generation."""
        self.seconds = 0.0
