"""Under which terms each generation of a run is asked and scored: its stage, and how warm it dreams.

Terms are a pure function of the run's settings and of what is finished before the generation opens.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from dreamfleet.common.heat import Heat
from dreamfleet.common.messages import TaskSpec
from dreamfleet.common.runs import RunFolder
from dreamfleet.common.stages import BegunStage, Stage, Stages
from dreamfleet.common.stored import RunSettings, StoredEvaluation, StoredGeneration


@dataclass(frozen=True)
class Terms:
    """Those of one generation."""

    spec: TaskSpec  # what its candidates are scored in, but for the episodes that a dream's stage drives
    begun: BegunStage

    @property
    def stage(self) -> Stage:
        """Its stage."""
        return self.begun.stage

    def spec_of(self, episode: int) -> TaskSpec:
        """What one episode of a candidate is scored in."""
        return self.spec.at(driven=episode < self.stage.driven_episodes or None)


class Agenda:
    """The terms of one generation after another; ask for generations in rising order."""

    def __init__(self, settings: RunSettings) -> None:
        self.stages = Stages(settings)
        self._heat = Heat(settings)
        self._own = settings.task

    def terms(
        self, generation: int, history: Sequence[StoredGeneration], finished: Mapping[int, StoredEvaluation]
    ) -> Terms:
        """Those of `generation`.

        `history` holds at least the generations before it, from the first on, and `finished` by generation the
        evaluations that it depends on.
        """
        begun = self.stages.at(generation, history, finished)
        return Terms(begun.stage.spec(self._own).at(self._heat.at(generation, finished)), begun)

    def awaited(self, generation: int) -> int:
        """The evaluation, by its generation, without which `generation`, the next one, cannot open; negative: none."""
        return max(self._heat.awaited(generation), self.stages.awaited(generation))

    def spec(self, generation: int) -> TaskSpec:
        """What the mean after `generation` is driven in where it is driven as candidates are, not evaluated."""
        return self.stages.of(generation).stage.spec(self._own)


def terms_at(
    generation: int, settings: RunSettings, history: Sequence[StoredGeneration],
    evaluations: Iterable[StoredEvaluation],
) -> Terms:  # fmt: skip
    """The terms of one `generation`, as `Agenda` tells them."""
    return Agenda(settings).terms(generation, history, {each.generation: each for each in evaluations})


def terms_of(run: RunFolder, generation: int) -> Terms:
    """The terms of a stored run's generation."""
    return terms_at(generation, run.settings, run.history(), run.evaluations())
