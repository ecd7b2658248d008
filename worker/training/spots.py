"""Spots: what deviates from the mean picture, and which of them a reconstruction keeps. Needs no labels.

A small spot, such as a ball, is little of a picture's error, and may decide the whole episode. Pages: takecover.md.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

DEVIATIONS = 4.0  # a pixel is of a spot if it is farther from the mean picture than so many mean deviations
KEPT = 0.5  # share of a spot's deviation that a reconstruction must show
SIZES = ((5, 16), (17, 64))  # least and most pixels of a class; fewer are mostly noise, more no encoder loses
BATCH = 100  # pictures at a time: their differences take 100 times the memory of one's
Pictures = NDArray[np.uint8]
Floats = NDArray[np.float64]


class Spots(NamedTuple):
    """A row for each spot: its pixels, its middle's row and column as shares of the side, and whether it is kept."""

    size: NDArray[np.int64]
    row: Floats
    column: Floats
    kept: NDArray[np.bool_]

    def of_size(self, least: int, most: int) -> "Spots":
        """Those of so many pixels."""
        among = (self.size >= least) & (self.size <= most)
        return Spots(self.size[among], self.row[among], self.column[among], self.kept[among])


def measure_mean(pictures: Pictures) -> tuple[Floats, float]:
    """The mean picture `(side, side, 3)` of `(N, side, side, 3)`, and the mean of `|x - mean|`, both in bytes."""
    mean = pictures.mean(axis=0, dtype=np.float64)
    away = [np.abs(each - mean).sum() for each in _in_batches(pictures)]
    return mean, float(np.sum(away) / max(1, pictures.size))


def find_spots(pictures: Pictures, decoded: NDArray[Any], mean: Floats, deviation: float) -> Spots:
    """The spots of `pictures` `(N, side, side, 3)`, and which of them `decoded` keeps.

    `mean` and `deviation` are those of `measure_mean`.
    """
    found = [_find_in(*each, mean, deviation) for each in zip(_in_batches(pictures), _in_batches(decoded), strict=True)]
    return Spots(*map(np.concatenate, zip(*found, strict=True)))


def _in_batches(pictures: NDArray[Any]) -> list[NDArray[Any]]:
    return [pictures[start : start + BATCH] for start in range(0, max(1, len(pictures)), BATCH)]


def _find_in(pictures: Pictures, decoded: NDArray[Any], mean: Floats, deviation: float) -> Spots:
    away = pictures - mean
    mask = np.abs(away).mean(axis=3) > DEVIATIONS * deviation
    found, index, size = np.unique(_label(mask), return_inverse=True, return_counts=True)
    _, rows, columns = np.nonzero(mask)
    seen, shown = away[mask], decoded[mask] - mean[rows, columns]
    weights = (seen**2).sum(axis=1), (seen * shown).sum(axis=1), rows + 0.5, columns + 0.5
    whole, share, row, column = (np.bincount(index, each, len(found)).astype(np.float64) for each in weights)
    return Spots(size, row / size / len(mean), column / size / len(mean), share >= KEPT * whole)


def kept_shares(spots: Spots) -> dict[str, float]:
    """The share of the spots of each class that is kept, by name; a class without a spot is left out."""
    kept = {f"kept_of_spots_{least}_to_{most}": spots.of_size(least, most).kept for least, most in SIZES}
    return {name: round(float(each.mean()), 3) for name, each in kept.items() if each.size}


def _label(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """For each pixel of `mask` `(N, side, side)`, in order, the last pixel of its connected part, by its number."""
    number = np.cumsum(mask).reshape(mask.shape) - 1
    neighbours = ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[:, :, 1:], np.s_[:, :, :-1]))
    pairs = [np.stack([number[one], number[other]])[:, mask[one] & mask[other]] for one, other in neighbours]
    one, other = np.concatenate(pairs, axis=1)
    labels, before = np.arange(np.count_nonzero(mask)), np.arange(0)  # a pixel's label is a pixel of its part
    while not np.array_equal(labels, before):
        before = labels.copy()
        np.maximum.at(labels, one, before[other])
        np.maximum.at(labels, other, before[one])
        labels = labels[labels]  # the label's own label: few turns, though more for a spiral
    return labels
