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
    batches = zip(_in_batches(pictures), _in_batches(decoded), strict=True)
    found = [_find_in(seen - mean, shown - mean, deviation) for seen, shown in batches]
    return Spots(*map(np.concatenate, zip(*found, strict=True)))


def _in_batches(pictures: NDArray[Any]) -> list[NDArray[Any]]:
    return [pictures[start : start + BATCH] for start in range(0, max(1, len(pictures)), BATCH)]


def _find_in(seen: Floats, shown: Floats, deviation: float) -> Spots:
    """The spots of a batch, given as differences from the mean picture."""
    labels = _label(np.abs(seen).mean(axis=3) > DEVIATIONS * deviation)
    flat = labels.ravel()
    found, index = np.unique(flat[flat > 0], return_inverse=True)
    size = np.bincount(index, minlength=len(found))
    rows, columns = np.divmod(np.flatnonzero(flat) % labels[0].size, labels.shape[2])

    def total(values: Floats) -> Floats:
        return np.bincount(index, values, len(found)).astype(np.float64)

    whole, share = (total(each.sum(axis=3).ravel()[flat > 0]) for each in (seen**2, seen * shown))
    side = labels.shape[1]
    return Spots(size, total(rows + 0.5) / size / side, total(columns + 0.5) / size / side, share >= KEPT * whole)


def kept_shares(spots: Spots) -> dict[str, float]:
    """The share of the spots of each class that is kept, by name; a class without a spot is left out."""
    kept = {f"kept_of_spots_{least}_to_{most}": spots.of_size(least, most).kept for least, most in SIZES}
    return {name: round(float(each.mean()), 3) for name, each in kept.items() if each.size}


def _label(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """A number for each connected part of each picture's `mask` `(N, side, side)`, unique over all; 0: none."""
    labels = np.where(mask, np.arange(mask.size).reshape(mask.shape), -1)  # a pixel's label is a pixel of its part
    while True:
        before = labels.copy()
        for one, other in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[:, :, 1:], np.s_[:, :, :-1])):
            for into, of in ((one, other), (other, one)):
                np.maximum(labels[into], labels[of], out=labels[into], where=mask[into])
        labels[mask] = labels.ravel()[labels[mask]]  # the label's own label: few turns, though more for a spiral
        if np.array_equal(labels, before):
            return labels + 1
