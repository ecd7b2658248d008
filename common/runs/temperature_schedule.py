"""The temperature of a run's dreams, which rises each time that evaluations of the mean fall.

A generation's temperature is a pure function of the run's settings and of evaluations that finished before it opens.
So a run that is interrupted anywhere continues bit-identically.
"""

from __future__ import annotations

from collections.abc import Mapping

from dreamfleet.common.protocol.messages import MAX_TEMPERATURE
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation
from dreamfleet.common.runs.stages import latest_usable_evaluation


class TemperatureSchedule:
    """Computes the temperature of one generation after another, reading each evaluation once.

    An evaluation clearly below the best one since the last increase multiplies the temperature by the run's `heat`, up
    to `MAX_TEMPERATURE`. Only scheduled evaluations count, as the final one depends on when a run was interrupted.
    """

    def __init__(self, settings: RunSettings) -> None:
        self._settings = settings
        self._temperature = settings.task.temperature
        self._best: StoredEvaluation | None = None  # since the last increase
        self._next = settings.evaluate_every - 1  # generation of the next evaluation to read

    def required_evaluation(self, generation: int) -> int:
        """The generation of the last evaluation that `generation`'s temperature depends on; negative: none."""
        return -1 if self._settings.heat == 1 else latest_usable_evaluation(self._settings.evaluate_every, generation)

    def temperature_at(self, generation: int, finished: Mapping[int, StoredEvaluation]) -> float | None:
        """The temperature of `generation`, `None` if the task has none; request generations in ascending order.

        `finished` holds, by generation, at least the evaluations that it depends on.
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
