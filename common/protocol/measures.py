"""Measures: numbers that say how a candidate behaved, beside its fitness, and the axes of an archive of them.

What a measure's name means stands in `docs/how-to/quality-diversity.md`; `worker/tasks/measures.py` computes it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.schema.validation import Word

MAX_AXES = 4
MAX_CELLS = 10_000  # of an archive
MAX_AXIS = 100  # characters of an axis as text
LARGEST_MEASURE = 1e100
EPSILON = 1e-6  # as in pyribs: a measure on a cell's lower bound lies in it whatever its last bits are
NO_ARCHIVE = "none"
STEPS, INFO, TRUTH = "steps", "info.", "truth."

MeasureNames = Annotated[tuple[Word, ...], Meta(max_length=MAX_AXES)]
Measures = Annotated[
    tuple[Annotated[float, Meta(ge=-LARGEST_MEASURE, le=LARGEST_MEASURE)], ...], Meta(max_length=MAX_AXES)
]  # of one episode, in the order of the names


@dataclass(frozen=True)
class Axis:
    """One axis of an archive: a measure, its range, and into how many cells of equal width the range is cut.

    >>> axis = Axis.parse("steps=0:500:10")
    >>> axis.cell_of(120.0), axis.cell_of(9000.0), axis.bounds_of(2)
    (2, 9, (100.0, 150.0))
    """

    measure: str
    low: float
    high: float
    cells: int

    @classmethod
    def parse(cls, text: str) -> Axis:
        """The axis that `MEASURE=LOW:HIGH:CELLS` describes; `UsageError` for any other text."""
        name, _, numbers = text.partition("=")
        try:
            ends = numbers.split(":")
            low, high, cells = float(ends[0]), float(ends[1]), int(ends[2])
            if len(ends) != 3:
                raise ValueError
        except (ValueError, IndexError):
            raise UsageError(f"--archive takes MEASURE=LOW:HIGH:CELLS, such as steps=0:500:20, not {text!r}") from None
        if not name or len(text) > MAX_AXIS or not name.isprintable() or any(map(str.isspace, name)):
            raise UsageError(f"--archive {text!r:.{MAX_AXIS}}: a measure's name is a short word")
        if not -LARGEST_MEASURE <= low < high <= LARGEST_MEASURE or high - low == 0:
            raise UsageError(f"--archive {text!r}: the range must be from a number to a larger one")
        if not 1 <= cells <= MAX_CELLS:
            raise UsageError(f"--archive {text!r}: an axis has 1 to {MAX_CELLS:,} cells")
        return cls(name, low, high, cells)

    def cell_of(self, value: float) -> int:
        """The number of the cell in which a value lies; values outside the range lie in the first or last cell."""
        inside = min(max(value, self.low), self.high)
        place = (self.cells * (inside - self.low) + EPSILON) / (self.high - self.low)
        return min(int(place), self.cells - 1)

    def bounds_of(self, cell: int) -> tuple[float, float]:
        """From where to where a cell reaches."""
        width = (self.high - self.low) / self.cells
        return self.low + cell * width, self.low + (cell + 1) * width

    @property
    def middles(self) -> list[float]:
        """The middle of each cell."""
        return [sum(self.bounds_of(cell)) / 2 for cell in range(self.cells)]

    @property
    def edges(self) -> NDArray[np.float64]:
        """The bounds of all cells `(cells + 1,)`."""
        return np.linspace(self.low, self.high, self.cells + 1)


def parse_axes(texts: Sequence[str]) -> tuple[Axis, ...]:
    """The axes of an archive; `UsageError` if one is wrong, named twice, or if there are too many cells."""
    axes = tuple(Axis.parse(text) for text in texts)
    if len(axes) > MAX_AXES or len({axis.measure for axis in axes}) < len(axes):
        raise UsageError(f"--archive takes 1 to {MAX_AXES} measures, each once")
    if (cells := math.prod(axis.cells for axis in axes)) > MAX_CELLS:
        raise UsageError(f"--archive has {cells:,} cells, {MAX_CELLS:,} at most: give some axis fewer")
    return axes


def check_dreamt(names: Sequence[str]) -> None:
    """`UsageError` for measures of the world itself, which no dream has."""
    if real := [name for name in names if name.startswith((INFO, TRUTH))]:
        raise UsageError(
            f"--archive: a dream has no {', '.join(real)}; it has steps and what the controller does, such as "
            "gas, steer.abs or brake.share"
        )
