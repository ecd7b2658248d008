"""The re-evaluated mean: whole episodes on the same validation tracks each time."""

from __future__ import annotations

from dataclasses import dataclass

from common.messages import TaskSpec
from common.seeds import validation_seeds
from coordinator.jobs import Work, make_work


@dataclass(frozen=True)
class Evaluation:
    """The distribution's mean after `generation`, as float32 bytes, to be driven on `episodes` tracks."""

    generation: int
    vector: bytes
    episodes: int

    def work(self, spec: TaskSpec) -> list[Work]:
        """Its jobs."""
        return make_work(spec, "evaluate", self.generation, 0, self.vector, validation_seeds(self.episodes))
