"""The best candidate of each cell, whichever optimiser asked for it. Pages: quality-diversity.md."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from dreamfleet.common.client.status import ArchiveStatus
from dreamfleet.common.protocol.measures import Axis, parse_axes
from dreamfleet.common.runs.records import RunSettings


@dataclass(frozen=True)
class Elite:
    """The best candidate of a cell: its place in the journal, its fitness and its measures, means over its episodes."""

    cell: tuple[int, ...]
    generation: int
    candidate: int
    fitness: float
    measures: tuple[float, ...]


@dataclass(frozen=True)
class EliteArchive:
    """A grid over the axes with at most one elite in each cell."""

    axes: tuple[Axis, ...]
    elites: dict[tuple[int, ...], Elite]

    @classmethod
    def empty(cls, settings: RunSettings) -> Self | None:
        """The archive of a run before its first generation is closed; `None` if it measures nothing."""
        axes = parse_axes(settings.archive)
        return cls(axes, {}) if axes else None

    def add(self, generation: int, number: int, fitness: float, measures: Sequence[float]) -> None:
        """Add a candidate, unless it lacks a measure or its cell has one that is as good."""
        if len(measures) != len(self.axes):
            return
        cell = tuple(axis.cell_of(value) for axis, value in zip(self.axes, measures, strict=True))
        if cell not in self.elites or fitness > self.elites[cell].fitness:
            self.elites[cell] = Elite(cell, generation, number, fitness, tuple(measures))

    @property
    def cells(self) -> int:
        """How many cells there are."""
        return math.prod(axis.cells for axis in self.axes)

    @property
    def qd_score(self) -> float:
        """The sum of the elites' fitness."""
        return math.fsum(elite.fitness for elite in self.elites.values())

    @property
    def best(self) -> Elite | None:
        """The elite of the highest fitness; `None` while there is none."""
        return max(self.elites.values(), key=lambda elite: elite.fitness, default=None)

    @property
    def status(self) -> ArchiveStatus:
        """Its figures, as a run's status has them."""
        best = self.best
        fitness, cell = (None, ()) if best is None else (best.fitness, best.cell)
        return ArchiveStatus(self.cells, len(self.elites), self.qd_score, fitness, cell)
