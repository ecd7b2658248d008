"""Which runs have refused a worker, and when to ask each again. Pure."""

from __future__ import annotations

# Seconds until a run is asked again: the first pause, and the longest; each refusal doubles it.
FIRST_DELAY, MAX_DELAY = 15.0, 600.0  # of a worker that may serve any run
SINGLE_RUN_DELAYS = 1.0, 60.0  # of a worker that serves one run


class RefusalBackoff:
    """The runs that refused this worker, with their reasons and pauses."""

    def __init__(self, first: float = FIRST_DELAY, longest: float = MAX_DELAY) -> None:
        self._first, self._longest = first, longest
        self._reasons: dict[str, str] = {}  # the last one of each run
        self._pause: dict[str, float] = {}
        self._until: dict[str, float] = {}

    def add(self, run: str, now: float) -> float:
        """Record a refusal; return the seconds until the run may be asked again.

        R23: a refused worker asks again for as long as it lives, because the reason may pass and anybody could have
        answered. Pauses grow, so that asking costs little.
        """
        pause = min(2 * self._pause.get(run, self._first / 2), self._longest)
        self._pause[run], self._until[run] = pause, now + pause
        return pause

    def is_news(self, run: str, reason: str) -> bool:
        """Whether a run refuses for another reason than the last time."""
        before = self._reasons.get(run)
        self._reasons[run] = reason
        return reason != before

    def forget(self, run: str) -> None:
        """Forget a run's refusals: it has accepted this worker."""
        for each in (self._reasons, self._pause, self._until):
            each.pop(run, None)

    def refusing_runs(self, now: float) -> set[str]:
        """Runs that must not be asked now."""
        return {run for run, until in self._until.items() if now < until}
