"""Drives of the mean that are kept: the next world model then learns from what evolved controllers see."""

from __future__ import annotations

from dataclasses import dataclass

from dreamfleet.common.messages import TaskSpec
from dreamfleet.common.seeds import collection_seed
from dreamfleet.coordinator.jobs import Work, make_work


@dataclass(frozen=True)
class Collection:
    """The distribution's mean after `generation`, as float32 bytes, to be driven on `episodes` training tracks."""

    generation: int
    vector: bytes
    episodes: int

    def work(self, spec: TaskSpec, run_seed: int) -> list[Work]:
        """Its jobs."""
        seeds = [collection_seed(run_seed, self.generation, episode) for episode in range(self.episodes)]
        return make_work(spec, "collect", self.generation, 0, self.vector, seeds)
