"""The scoring parameters of each generation of a run: its stage, and what that changes.

They are a pure function of the run's settings and of the generations and evaluations finished before it opens.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.stages import BegunStage, Stage, StageTracker

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
        self._own = settings.task

    def scoring_params(
        self, generation: int, history: Sequence[StoredGeneration], finished: Mapping[int, StoredEvaluation]
    ) -> ScoringParams:
        """The scoring parameters of `generation`.

        `history` holds at least all generations before it; `finished`, by generation, at least the evaluations that it
        depends on.
        """
        begun = self.stages.advance_to(generation, history, finished)
        return ScoringParams(begun.stage.spec(self._own), begun)

    def required_evaluation(self, generation: int) -> int:
        """The generation of the evaluation that must finish before the next `generation` opens; negative: none."""
        return self.stages.required_evaluation(generation)

    def spec(self, generation: int) -> TaskSpec:
        """The specification of collecting rollouts with the mean after `generation`."""
        return self.stages.stage_of(generation).stage.spec(self._own)


def scoring_params_at(
    generation: int, settings: RunSettings, history: Sequence[StoredGeneration],
    evaluations: Iterable[StoredEvaluation],
) -> ScoringParams:  # fmt: skip
    """The scoring parameters of one `generation`, as `ScheduleState` computes them."""
    return ScheduleState(settings).scoring_params(generation, history, {each.generation: each for each in evaluations})


def scoring_params_of(run: RunFolder, generation: int) -> ScoringParams:
    """The scoring parameters of a stored run's generation."""
    return scoring_params_at(generation, run.settings, run.history(), run.evaluations())
