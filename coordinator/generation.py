"""One generation: a population, its jobs, the results so far. Pure: no clock, no transport."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from common.messages import TaskSpec
from coordinator.jobs import Work, make_work


class Generation:
    """Which candidate's which episode each digest is, and its fitness once known."""

    def __init__(self, number: int, spec: TaskSpec, vectors: Sequence[bytes], seeds: Sequence[int]) -> None:
        self.number = number
        self.work = [
            work
            for candidate, vector in enumerate(vectors)
            for work in make_work(spec, "score", number, candidate, vector, seeds)
        ]
        # Equal vectors have equal digests: one job then fills the place of each of them.
        self._places: dict[bytes, list[tuple[int, int]]] = {}
        for work in self.work:
            self._places.setdefault(work.job.digest, []).append((work.job.candidate, work.job.episode))
        self._scores = np.full((len(vectors), len(seeds)), np.nan)
        self.steps = 0

    @property
    def missing(self) -> list[Work]:
        """Jobs without a result, each digest once, candidate by candidate."""
        first = {work.job.digest: work for work in reversed(self.work)}
        return [first[digest] for digest, places in self._places.items() if np.isnan(self._scores[places[0]])]

    @property
    def done(self) -> int:
        """Episodes scored."""
        return int(np.isfinite(self._scores).sum())

    @property
    def total(self) -> int:
        """Episodes wanted."""
        return self._scores.size

    @property
    def complete(self) -> bool:
        """Whether every episode is scored."""
        return self.done == self.total

    def record(self, digest: bytes, fitness: float, steps: int) -> None:
        """Take one accepted result of this generation."""
        for place in self._places[digest]:
            self._scores[place] = fitness
        self.steps += steps

    def fitness(self) -> NDArray[np.float64]:
        """What the strategy is told `(population,)`: the mean of each candidate's episodes."""
        return np.asarray(self._scores.mean(axis=1))
