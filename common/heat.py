"""How warm a run dreams: its temperature is raised each time that evaluations of its mean fall.

A generation's temperature is a pure function of the run's settings and of evaluations that are finished before it
opens, so that a life of the coordinator that is interrupted anywhere goes on to the bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from dreamfleet.common.messages import HOTTEST, TaskSpec
from dreamfleet.common.runs import RunFolder, RunSettings, StoredEvaluation


def deciding_check(settings: RunSettings, generation: int) -> int:
    """The last evaluation, by its generation, that `generation`'s temperature depends on; negative: on none.

    It was scheduled at least `evaluate_every` generations earlier, which is the time that driving it may take.
    """
    every = settings.evaluate_every
    return -1 if settings.heat == 1 else (generation // every - 1) * every - 1


class Heat:
    """The temperature of one generation after another; each evaluation is looked at once, however long the run is.

    Each evaluation that lies clearly behind the best one since the last raise multiplies the temperature by the run's
    heat, up to `HOTTEST`. Only evaluations that the schedule wants count: one that a limit called for depends on when a
    run was interrupted.
    """

    def __init__(self, settings: RunSettings) -> None:
        self._settings = settings
        self._temperature = settings.task.temperature
        self._best: StoredEvaluation | None = None  # since the last raise
        self._next = settings.evaluate_every - 1  # the check to look at next, by its generation

    def temperature(self, generation: int, finished: Mapping[int, StoredEvaluation]) -> float | None:
        """What `generation` dreams at; `None` where it is the run's own. Ask for generations in rising order.

        `finished` holds by generation at least the evaluations that this one depends on.
        """
        own, last = self._settings.task.temperature, deciding_check(self._settings, generation)
        if own is None or last < 0:
            return None
        while self._next <= last:
            if (check := finished.get(self._next)) is not None:
                self._look(check)
            self._next += self._settings.evaluate_every
        return None if self._temperature == own else self._temperature

    def _look(self, check: StoredEvaluation) -> None:
        if self._best is not None and check.behind(self._best):
            assert self._temperature is not None
            self._temperature, self._best = min(self._temperature * self._settings.heat, HOTTEST), None
        elif self._best is None or check.mean > self._best.mean:
            self._best = check


def raised_temperature(generation: int, settings: RunSettings, evaluations: Iterable[StoredEvaluation]) -> float | None:
    """The temperature that one `generation` dreams at, as `Heat` tells it; `None` where it is the run's own."""
    return Heat(settings).temperature(generation, {each.generation: each for each in evaluations})


def spec_of(run: RunFolder, generation: int) -> TaskSpec:
    """What the candidates of a stored run's generation are scored in."""
    return run.spec.at(raised_temperature(generation, run.settings, run.evaluations()))
