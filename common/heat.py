"""How warm a run dreams: its temperature is raised each time that evaluations of its mean fall.

A generation's temperature is a pure function of the run's settings and of evaluations that are finished before it
opens, so that a life of the coordinator that is interrupted anywhere goes on to the bit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from dreamfleet.common.messages import HOTTEST, TaskSpec
from dreamfleet.common.runs import RunFolder
from dreamfleet.common.stored import RunSettings, StoredEvaluation


def deciding_evaluation(settings: RunSettings, generation: int) -> int:
    """The last evaluation, by its generation, that `generation`'s temperature depends on; negative: on none.

    It was scheduled at least `evaluate_every` generations earlier, which is the time that driving it may take.
    """
    every = settings.evaluate_every
    return -1 if settings.heat == 1 else (generation // every - 1) * every - 1


class Heat:
    """What one generation after another is scored in: the run's specification, perhaps at a raised temperature.

    Each evaluation is looked at once, however long the run is.

    Each evaluation that lies clearly behind the best one since the last raise multiplies the temperature by the run's
    heat, up to `HOTTEST`. Only evaluations that the schedule wants count: one that a limit called for depends on when a
    run was interrupted.
    """

    def __init__(self, settings: RunSettings) -> None:
        self._settings = settings
        self._temperature = settings.task.temperature
        self._best: StoredEvaluation | None = None  # since the last raise
        self._next = settings.evaluate_every - 1  # the one to look at next, by its generation

    def spec(self, generation: int, finished: Mapping[int, StoredEvaluation]) -> TaskSpec:
        """What `generation` is scored in. Ask for generations in rising order.

        `finished` holds by generation at least the evaluations that this one depends on.
        """
        own, last = self._settings.task, deciding_evaluation(self._settings, generation)
        if own.temperature is None or last < 0:
            return own
        while self._next <= last:
            if (evaluation := finished.get(self._next)) is not None:
                self._look(evaluation)
            self._next += self._settings.evaluate_every
        return own.at(self._temperature)

    def _look(self, evaluation: StoredEvaluation) -> None:
        if self._best is not None and evaluation.behind(self._best):
            assert self._temperature is not None
            self._temperature, self._best = min(self._temperature * self._settings.heat, HOTTEST), None
        elif self._best is None or evaluation.mean > self._best.mean:
            self._best = evaluation


def spec_at(generation: int, settings: RunSettings, evaluations: Iterable[StoredEvaluation]) -> TaskSpec:
    """What one `generation` is scored in, as `Heat` tells it."""
    return Heat(settings).spec(generation, {each.generation: each for each in evaluations})


def spec_of(run: RunFolder, generation: int) -> TaskSpec:
    """What the candidates of a stored run's generation are scored in."""
    return spec_at(generation, run.settings, run.evaluations())
