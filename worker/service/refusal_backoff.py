"""Which runs have refused a worker, and when to ask again. Pure: a clock in, whom not to ask out.

What a run refuses for may pass: another run takes the name, its coordinator comes back with other settings. And whoever
reaches the port can refuse in its name. So it is asked again, ever later, for as long as the worker lives.
"""

from __future__ import annotations

FIRST_DELAY, MAX_DELAY = (
    15.0,
    600.0,
)  # seconds until a run is asked again by a worker that has others: doubled each time
SINGLE_RUN_DELAYS = 1.0, 60.0  # the same of one that has not


class RefusalBackoff:
    """Runs that said no, and until when they are left alone."""

    def __init__(self, first: float = FIRST_DELAY, longest: float = MAX_DELAY) -> None:
        self._first, self._longest = first, longest
        self._why: dict[str, str] = {}  # what was last said of each
        self._pause: dict[str, float] = {}
        self._until: dict[str, float] = {}

    def add(self, run: str, now: float) -> float:
        """A run said no; for how many seconds it is left alone."""
        pause = min(2 * self._pause.get(run, self._first / 2), self._longest)
        self._pause[run], self._until[run] = pause, now + pause
        return pause

    def is_news(self, run: str, why: str) -> bool:
        """Whether this is not what a run said the last time."""
        before = self._why.get(run)
        self._why[run] = why
        return why != before

    def forget(self, run: str) -> None:
        """A run has this worker score: what it refused before is past."""
        for each in (self._why, self._pause, self._until):
            each.pop(run, None)

    def refusing_runs(self, now: float) -> set[str]:
        """Runs not to ask now."""
        return {run for run, until in self._until.items() if now < until}
