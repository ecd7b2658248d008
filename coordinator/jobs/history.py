"""Closed generations with running sums, so that a query costs the same however long a run is. Pure. Pages: tasks.md."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dreamfleet.common.client.equal_fitness import EqualFitness
from dreamfleet.common.protocol.result_bounds import clamp_count, to_finite
from dreamfleet.common.runs.records import StoredGeneration

LEAST_IMPROVEMENT = 1e-11  # of the best fitness that counts, as pycma's `tolfun`; less where fitness spans less than 1


class History:
    """Every closed generation, oldest first; it only grows."""

    def __init__(self, rows: Iterable[StoredGeneration] = ()) -> None:
        self.steps = 0  # environment steps of all generations
        self.seconds = 0.0  # in which they could be scored
        self.failed = 0  # candidates
        self.equal = EqualFitness()
        self.best: float | None = None  # fitness of a candidate
        self.improved = 0  # the last generation whose best candidate beat the one of the last such generation
        self.least_improvement = LEAST_IMPROVEMENT  # of the best fitness that counts
        self._level = 0.0  # the fitness of that
        self._rows: list[StoredGeneration] = []
        for row in rows:
            self.append(row)

    def append(self, row: StoredGeneration) -> None:
        """Add the generation that was just closed."""
        if self.best is None and row.best > row.worst:
            self.least_improvement = LEAST_IMPROVEMENT * min(1.0, row.best - row.worst)
        if self.best is None or row.best > self._level + self.least_improvement:
            self._level, self.improved = row.best, len(self._rows)
        self.best = row.best if self.best is None else max(self.best, row.best)
        self._rows.append(row)
        self.equal.add(row)
        self.steps = clamp_count(self.steps + row.steps)
        self.failed = clamp_count(self.failed + row.failed)
        self.seconds = to_finite(self.seconds + row.seconds)

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def rows(self) -> Sequence[StoredGeneration]:
        """All closed generations, not copied: do not change the list."""
        return self._rows

    @property
    def last(self) -> StoredGeneration | None:
        """The generation that was closed last."""
        return self._rows[-1] if self._rows else None

    def view(self) -> HistoryView:
        """A view of the history as it is now, for other threads; nothing is copied."""
        return HistoryView(self._rows, len(self._rows))


class HistoryView:
    """The first `length` rows of a list that only grows, so that any thread may read them at any time."""

    def __init__(self, rows: list[StoredGeneration], length: int) -> None:
        self._rows = rows
        self._length = length

    def __len__(self) -> int:
        return self._length

    def part(self, offset: int, limit: int) -> list[StoredGeneration]:
        """At most `limit` rows from `offset` on."""
        return self._rows[offset : min(offset + limit, self._length)]
