"""What chance adds to a dream: a pure function of the episode's seed, the same for every candidate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.dream.beginnings import Beginnings
from dreamfleet.worker.worldmodel.inference import Chance

Floats = NDArray[np.float32]
PIECE = 64  # steps drawn at once: a horizon of any length costs no more memory


@dataclass(frozen=True)
class Draw:
    """Noise `(rows, latent)` of a step, or of several: which mixture is chosen, and where in it.

    `mask` `(rows, hidden)` is the dropout of models that were trained with it: 0 or 1 / (1 - rate).
    """

    uniform: Floats
    normal: Floats
    mask: Floats | None = None

    def each(self, change: Callable[[Floats], Floats]) -> Draw:
        """Every part of it, changed."""
        return Draw(change(self.uniform), change(self.normal), None if self.mask is None else change(self.mask))


def side_by_side(draws: Sequence[Draw], axis: int) -> Draw:
    """Draws of as many dreamers, joined along a new axis."""

    def join(*parts: Floats) -> Floats:
        return np.stack(parts, axis=axis)

    masks: list[Any] = [draw.mask for draw in draws]
    uniform, normal = join(*(draw.uniform for draw in draws)), join(*(draw.normal for draw in draws))
    return Draw(uniform, normal, None if masks[0] is None else join(*masks))


class Begun(NamedTuple):
    """A dream's first latent, and what the model remembers there: `(latent,)` and `(memory,)`, or a row a dream."""

    latent: Floats
    memory: Floats


class Noise:
    """The noise of one episode, step after step, and its beginning."""

    def __init__(self, seed: int, chance: Chance) -> None:
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._seed = seed
        self._chance = chance
        self._left = 0

    def begin(self, beginnings: Beginnings) -> Begun:
        """Where the dream begins; to be called first. Wherever that is, the noise of its steps is the same."""
        first = int(self._random.integers(len(beginnings.initial)))
        mu, logvar, memory = beginnings.choose(self._seed, first)
        normal = self._random.standard_normal(self._chance.latent, dtype=np.float32)
        return Begun(mu + np.exp(0.5 * logvar) * normal, memory)

    def piece(self) -> Draw:
        """The noise of the next `PIECE` steps, a row each."""
        latent, hidden, rate = self._chance
        uniform = self._random.random((PIECE, latent), dtype=np.float32)
        normal = self._random.standard_normal((PIECE, latent), dtype=np.float32)
        if not rate:
            return Draw(uniform, normal)
        kept = self._random.random((PIECE, hidden), dtype=np.float32) >= rate
        return Draw(uniform, normal, kept.astype(np.float32) / np.float32(1 - rate))

    def next(self) -> Draw:
        """The next step's noise, one row."""
        if self._left == 0:
            self._piece, self._left = self.piece(), PIECE
        step = PIECE - self._left
        self._left -= 1
        return self._piece.each(lambda part: part[step : step + 1])


class SharedNoise:
    """The noise of rows that dream few episodes between them: drawn once an episode, given to each of its rows."""

    def __init__(self, seeds: NDArray[np.int64], chance: Chance, beginnings: Beginnings) -> None:
        """`seeds` `(rows,)`: one a row."""
        unique, self._episode = np.unique(seeds, return_inverse=True)
        self._sources = [Noise(int(seed), chance) for seed in unique]
        begun = zip(*(source.begin(beginnings) for source in self._sources), strict=True)
        self.first = Begun(*(np.stack(parts)[self._episode] for parts in begun))
        self._left = 0

    def next(self, rows: NDArray[np.int64]) -> Draw:
        """The next step's noise of the rows that still dream."""
        if self._left == 0:
            self._pieces = side_by_side([source.piece() for source in self._sources], axis=1)
            self._left = PIECE
        step, episode = PIECE - self._left, self._episode[rows]
        self._left -= 1
        return self._pieces.each(lambda part: part[step].take(episode, axis=0))
