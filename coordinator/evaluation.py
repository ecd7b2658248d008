"""The re-evaluated mean: whole episodes on the same validation tracks each time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dreamfleet.common.messages import TaskSpec
from dreamfleet.common.runs import StoredEvaluation
from dreamfleet.common.seeds import validation_seeds
from dreamfleet.coordinator.jobs import Work, make_work


@dataclass(frozen=True)
class Evaluation:
    """The distribution's mean after `generation`, as float32 bytes, to be driven on `episodes` tracks."""

    generation: int
    vector: bytes
    episodes: int

    def work(self, spec: TaskSpec) -> list[Work]:
        """Its jobs."""
        return make_work(spec, "evaluate", self.generation, 0, self.vector, validation_seeds(self.episodes))


def parted(evaluations: Sequence[StoredEvaluation], count: int) -> bool:
    """Whether the last `count` evaluations each lie clearly behind the best before them.

    That is how a dream that is being exploited looks: fitness in the dream goes on rising, reality falls.
    """
    before, last = evaluations[:-count], evaluations[-count:]
    if not before:
        return False
    best = max(before, key=lambda each: each.mean)
    return all(each.behind(best) for each in last)
