"""How warm a run dreams: its temperature is raised each time that evaluations of its mean fall.

A generation's temperature is a pure function of the run's settings and of evaluations that are finished before it
opens, so that a life of the coordinator that is interrupted anywhere goes on to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping

from dreamfleet.common.protocol.messages import MAX_TEMPERATURE
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation
from dreamfleet.common.runs.stages import latest_usable_evaluation


class TemperatureSchedule:
    """The temperature of one generation after another: the run's own, perhaps raised.

    Each evaluation is looked at once, however long the run is.

    Each evaluation that lies clearly behind the best one since the last raise multiplies the temperature by the run's
    heat, up to `MAX_TEMPERATURE`. Only scheduled evaluations count: one that a
    limit triggered depends on when a run was interrupted.
    """

    def __init__(self, settings: RunSettings) -> None:
        self._settings = settings
        self._temperature = settings.task.temperature
        self._best: StoredEvaluation | None = None  # since the last raise
        self._next = settings.evaluate_every - 1  # the one to look at next, by its generation

    def required_evaluation(self, generation: int) -> int:
        """The last evaluation, by its generation, that `generation`'s temperature depends on; negative: on none."""
        return -1 if self._settings.heat == 1 else latest_usable_evaluation(self._settings.evaluate_every, generation)

    def temperature_at(self, generation: int, finished: Mapping[int, StoredEvaluation]) -> float | None:
        """`generation`'s temperature; `None` where a task has none. Ask for generations in rising order.

        `finished` holds by generation at least the evaluations that this one depends on.
        """
        last = self.required_evaluation(generation)
        if self._temperature is None or last < 0:
            return self._temperature
        while self._next <= last:
            if (evaluation := finished.get(self._next)) is not None:
                self._update(evaluation)
            self._next += self._settings.evaluate_every
        return self._temperature

    def _update(self, evaluation: StoredEvaluation) -> None:
        if self._best is not None and evaluation.is_clearly_below(self._best):
            assert self._temperature is not None
            self._temperature, self._best = min(self._temperature * self._settings.heat, MAX_TEMPERATURE), None
        elif self._best is None or evaluation.mean > self._best.mean:
            self._best = evaluation
