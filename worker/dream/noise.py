"""The random numbers of a dream: a pure function of the episode's seed, the same for every candidate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.dream.start_states import StartStates
from dreamfleet.worker.worldmodel.inference import NoiseSize

Floats = NDArray[np.float32]
# From random numbers in [0, 1) of some steps `(n,)` to the bars `(n,)` above which a predicted end comes true there.
Bars = Callable[[NDArray[np.float64]], Floats]
BLOCK_STEPS = 64  # steps drawn at once, so that memory does not grow with the horizon
END_SPAWN_KEY = (2,)  # gives the ends their own random numbers: with or without them, all others are the same


@dataclass(frozen=True)
class Draw:
    """Random numbers of one step, or of several, each `(rows, latent)`.

    `uniform` chooses the mixture component, `normal` the value within it. `mask` `(rows, hidden)` is the dropout of
    models that were trained with it: 0 or 1 / (1 - rate). `bar` `(rows, 1)` is given where ends are drawn.
    """

    uniform: Floats
    normal: Floats
    mask: Floats | None = None
    bar: Floats | None = None

    def map(self, change: Callable[[Floats], Floats]) -> Draw:
        """A draw with `change` applied to each array."""
        others = (None if each is None else change(each) for each in (self.mask, self.bar))
        return Draw(change(self.uniform), change(self.normal), *others)


def stack_draws(draws: Sequence[Draw], axis: int) -> Draw:
    """Join draws along a new axis."""

    def join(name: str) -> Any:
        parts = [getattr(draw, name) for draw in draws]
        return None if parts[0] is None else np.stack(parts, axis=axis)

    return Draw(*(join(each.name) for each in fields(Draw)))


class DreamStart(NamedTuple):
    """A dream's first latent `(latent,)` and the model's memory `(memory,)` there; or one row a dream."""

    latent: Floats
    memory: Floats


class EpisodeNoise:
    """The random numbers of one episode: its start, and then each step. With `bars` its ends are drawn."""

    def __init__(self, seed: int, chance: NoiseSize, bars: Bars | None = None) -> None:
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._seed = seed
        self._chance, self._bars = chance, bars
        if bars is not None:
            own = np.random.SeedSequence(seed, spawn_key=END_SPAWN_KEY)
            self._end_random = np.random.Generator(np.random.PCG64(own))
        self._left = 0

    def begin(self, start_states: StartStates) -> DreamStart:
        """Where the dream starts; call it first. The noise of the steps does not depend on the start."""
        first = int(self._random.integers(len(start_states.initial)))
        mu, logvar, memory = start_states.choose(self._seed, first)
        normal = self._random.standard_normal(self._chance.latent, dtype=np.float32)
        return DreamStart(mu + start_states.deviation(logvar) * normal, memory)

    def draw_block(self) -> Draw:
        """The draw of the next `BLOCK_STEPS` steps, one row each."""
        latent, hidden, rate = self._chance
        uniform = self._random.random((BLOCK_STEPS, latent), dtype=np.float32)
        normal = self._random.standard_normal((BLOCK_STEPS, latent), dtype=np.float32)
        bar = None if self._bars is None else self._bars(self._end_random.random(BLOCK_STEPS))[:, None]
        if not rate:
            return Draw(uniform, normal, bar=bar)
        kept = self._random.random((BLOCK_STEPS, hidden), dtype=np.float32) >= rate
        return Draw(uniform, normal, kept.astype(np.float32) / np.float32(1 - rate), bar)

    def next(self) -> Draw:
        """The draw of the next step, one row."""
        if self._left == 0:
            self._block, self._left = self.draw_block(), BLOCK_STEPS
        step = BLOCK_STEPS - self._left
        self._left -= 1
        return self._block.map(lambda part: part[step : step + 1])


class SharedNoise:
    """The random numbers of many rows with few different seeds: drawn once a seed, and shared by its rows."""

    def __init__(
        self, seeds: NDArray[np.int64], chance: NoiseSize, start_states: StartStates, bars: Bars | None = None
    ) -> None:
        """`seeds` `(rows,)`, one for each row."""
        unique, self.episode = np.unique(seeds, return_inverse=True)  # each row's column in `next_block`
        self._sources = [EpisodeNoise(int(seed), chance, bars) for seed in unique]
        begun = zip(*(source.begin(start_states) for source in self._sources), strict=True)
        self.first = DreamStart(*(np.stack(parts)[self.episode] for parts in begun))
        self._left = 0

    def next(self, rows: NDArray[np.int64]) -> Draw:
        """The draw of the next step for the rows with these indices."""
        if self._left == 0:
            self._blocks = self.next_block()
            self._left = BLOCK_STEPS
        step, episode = BLOCK_STEPS - self._left, self.episode[rows]
        self._left -= 1
        return self._blocks.map(lambda part: part[step].take(episode, axis=0))

    def next_block(self) -> Draw:
        """The draws of the next `BLOCK_STEPS` steps `(steps, seeds, ...)`, one column a seed; not beside `next`."""
        return stack_draws([source.draw_block() for source in self._sources], axis=1)
