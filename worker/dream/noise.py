"""What chance adds to a dream: a pure function of the episode's seed, the same for every candidate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
PIECE = 64  # steps drawn at once: a horizon of any length costs no more memory


@dataclass(frozen=True)
class Draw:
    """Noise `(rows, latent)` of a step, or of steps: which mixture is chosen, and where in it."""

    uniform: Floats
    normal: Floats


class Noise:
    """The noise of one episode, step after step, and its beginning."""

    def __init__(self, seed: int, latent: int) -> None:
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._latent = latent
        self._left = 0

    def begin(self, initial: Floats) -> Floats:
        """A first latent `(latent,)` from recorded ones `(N, 2, latent)`, mu and logvar; to be called first."""
        mu, logvar = initial[self._random.integers(len(initial))]
        normal = self._random.standard_normal(self._latent, dtype=np.float32)
        first: Floats = mu + np.exp(0.5 * logvar) * normal
        return first

    def piece(self) -> Draw:
        """Uniform and normal numbers of the next steps `(PIECE, latent)`."""
        uniform = self._random.random((PIECE, self._latent), dtype=np.float32)
        return Draw(uniform, self._random.standard_normal((PIECE, self._latent), dtype=np.float32))

    def next(self) -> tuple[Floats, Floats]:
        """Uniform and normal numbers `(latent,)` of the next step."""
        if self._left == 0:
            self._piece, self._left = self.piece(), PIECE
        step = PIECE - self._left
        self._left -= 1
        return self._piece.uniform[step], self._piece.normal[step]


class SharedNoise:
    """The noise of rows that dream few episodes between them: drawn once an episode, given to each of its rows."""

    def __init__(self, seeds: NDArray[np.int64], latent: int, initial: Floats) -> None:
        """`seeds` `(rows,)`: one a row."""
        unique, self._episode = np.unique(seeds, return_inverse=True)
        self._sources = [Noise(int(seed), latent) for seed in unique]
        self.first = np.stack([source.begin(initial) for source in self._sources])[self._episode]
        self._left = 0

    def next(self, rows: NDArray[np.int64]) -> Draw:
        """The next step's noise of the rows that still dream."""
        if self._left == 0:
            pieces = [source.piece() for source in self._sources]
            self._uniform = np.stack([piece.uniform for piece in pieces], axis=1)
            self._normal = np.stack([piece.normal for piece in pieces], axis=1)
            self._left = PIECE
        step, episode = PIECE - self._left, self._episode[rows]
        self._left -= 1
        return Draw(self._uniform[step].take(episode, axis=0), self._normal[step].take(episode, axis=0))
