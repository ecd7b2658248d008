"""The scoring parameters of each generation of a run: its stage, and the temperature of its dream.

They are a pure function of the run's settings and of the generations and evaluations finished before it opens.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dreamfleet.common.protocol.messages import MAX_TEMPERATURE, TaskSpec
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.stages import BegunStage, Stage, StageTracker, latest_usable_evaluation

if TYPE_CHECKING:
    from dreamfleet.common.runs.run_folder import RunFolder


@dataclass(frozen=True)
class ScoringParams:
    """The scoring parameters of one generation."""

    spec: TaskSpec  # of its candidates' episodes; `episode_spec` adds the driven ones
    begun: BegunStage

    @property
    def stage(self) -> Stage:
        """The generation's stage."""
        return self.begun.stage

    def episode_spec(self, episode: int) -> TaskSpec:
        """The specification of one episode of a candidate."""
        return self.spec.with_overrides(driven=episode < self.stage.driven_episodes or None)

    def job_digests(self, vectors: Iterable[bytes], seeds: Sequence[int]) -> Iterator[list[bytes]]:
        """The digests of each candidate's jobs, one a seed, from its float32 vector.

        R1: a digest names the vector and the seed, so a result that counts has another one than that of a
        discarded vector or of a replaced seed in the same place.
        """
        texts = [self.episode_spec(each).digest_text("score", (seed,)) for each, seed in enumerate(seeds)]
        for vector in vectors:
            identity = hashlib.sha256(vector).digest()
            yield [hashlib.sha256(identity + text).digest() for text in texts]


class ScheduleState:
    """Computes the scoring parameters of one generation after another, in ascending order."""

    def __init__(self, settings: RunSettings) -> None:
        self.stages = StageTracker(settings)
        self._settings = settings
        self._own = settings.task

    def scoring_params(
        self, generation: int, history: Sequence[StoredGeneration], finished: Mapping[int, StoredEvaluation]
    ) -> ScoringParams:
        """The scoring parameters of `generation`.

        `history` holds at least all generations before it; `finished`, by generation, at least the evaluations that it
        depends on.
        """
        begun = self.stages.advance_to(generation, history, finished)
        temperature = _temperature_at(generation, self._settings, finished)
        return ScoringParams(begun.stage.spec(self._own).with_overrides(temperature), begun)

    def required_evaluation(self, generation: int) -> int:
        """The generation of the evaluation that must finish before the next `generation` opens; negative: none."""
        return max(_raising_evaluation(generation, self._settings), self.stages.required_evaluation(generation))

    def spec(self, generation: int) -> TaskSpec:
        """The specification of collecting rollouts with the mean after `generation`."""
        return self.stages.stage_of(generation).stage.spec(self._own)


def _raising_evaluation(generation: int, settings: RunSettings) -> int:
    """The last evaluation, by its generation, that may raise the temperature of `generation`; negative: none."""
    return -1 if settings.heat == 1 else latest_usable_evaluation(settings.evaluate_every, generation)


def _temperature_at(
    generation: int, settings: RunSettings, finished: Mapping[int, StoredEvaluation]
) -> float | None:  # fmt: skip
    """The temperature of `generation`; `None` for tasks without one.

    It is constant in every run that can be started today. In older runs with `heat`, each scheduled evaluation clearly
    below the best one since the last raise multiplies the temperature by `heat`.
    """
    temperature, best = settings.task.temperature, None
    if temperature is None or (last := _raising_evaluation(generation, settings)) < 0:
        return temperature
    for number in range(settings.evaluate_every - 1, last + 1, settings.evaluate_every):
        evaluation = finished.get(number)
        if evaluation is not None and best is not None and _fell_behind(evaluation, best):
            temperature, best = min(temperature * settings.heat, MAX_TEMPERATURE), None
        elif evaluation is not None and (best is None or evaluation.mean > best.mean):
            best = evaluation
    return temperature


def _fell_behind(evaluation: StoredEvaluation, best: StoredEvaluation) -> bool:
    """The rule that runs with `heat` raised by, kept to the bit: unpaired errors with `episodes` in the denominator."""
    errors = (each.std / math.sqrt(each.episodes) for each in (best, evaluation))
    return best.mean - evaluation.mean > 2 * math.hypot(*errors)


def scoring_params_at(
    generation: int, settings: RunSettings, history: Sequence[StoredGeneration],
    evaluations: Iterable[StoredEvaluation],
) -> ScoringParams:  # fmt: skip
    """The scoring parameters of one `generation`, as `ScheduleState` computes them."""
    return ScheduleState(settings).scoring_params(generation, history, {each.generation: each for each in evaluations})


def scoring_params_of(run: RunFolder, generation: int) -> ScoringParams:
    """The scoring parameters of a stored run's generation."""
    return scoring_params_at(generation, run.settings, run.history(), run.evaluations())
