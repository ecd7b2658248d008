"""Which runs have refused a worker that serves any of them. Pure: a clock in, whom not to ask out.

What a run refuses for may pass: a package is installed, another run takes the name. So it is asked again, ever later.
"""

from __future__ import annotations

FIRST, LONGEST = 15.0, 600.0  # seconds until a run is asked again: doubled with each refusal


class Refusals:
    """Runs that said no, and until when they are left alone."""

    def __init__(self) -> None:
        self._pause: dict[str, float] = {}
        self._until: dict[str, float] = {}

    def add(self, run: str, now: float) -> float:
        """A run said no; for how many seconds it is left alone."""
        pause = min(2 * self._pause.get(run, FIRST / 2), LONGEST)
        self._pause[run], self._until[run] = pause, now + pause
        return pause

    def standing(self, now: float) -> set[str]:
        """Runs not to ask now."""
        return {run for run, until in self._until.items() if now < until}
