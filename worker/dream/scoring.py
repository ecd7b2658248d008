"""Scoring many candidates in the dream at once; a fitness is the same bits alone, in any batch, in any order."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from common.bundle import Bundle
from common.errors import UsageError
from common.messages import TaskSpec
from worker.dream.noise import SharedNoise
from worker.dream.world import DreamWorld
from worker.rollout import Score

DEFAULT_TEMPERATURE = 1.0
Dreamt = tuple[NDArray[np.float32], int]
"""A candidate's flat vector and the seed of its dream."""


class Dreamer:
    """Dreams a batch of episodes to their ends."""

    def __init__(self, bundle: Bundle, spec: TaskSpec) -> None:
        self._size = bundle.controller_shape.size
        self._horizon = spec.horizon
        self._world = DreamWorld(bundle, spec.temperature or DEFAULT_TEMPERATURE)

    def score(self, dreams: Sequence[Dreamt], on_step: Callable[[int], None] = lambda _: None) -> list[Score]:
        """The summed reward of each dream, in step order, in double precision; `on_step` hears of all steps so far."""
        parameters = np.stack([vector for vector, _ in dreams]).astype(np.float32)
        if parameters.shape[1] != self._size or not np.isfinite(parameters).all():
            raise UsageError(f"a dream needs controllers of {self._size} finite parameters")
        world, rows = self._world, np.arange(len(dreams))
        noise = SharedNoise(np.array([seed for _, seed in dreams]), world.latent_size, world.initial)
        fitness, steps = np.zeros(len(rows)), np.zeros(len(rows), dtype=np.int64)
        latent, state = noise.first, world.begin(len(rows))
        for _ in range(self._horizon):
            moment = world.live(latent, parameters, state, noise.next(rows))
            fitness[rows] += moment.reward
            steps[rows] += 1
            on_step(int(steps.sum()))
            latent, state = moment.latent, moment.state
            if moment.done.any():
                going = ~moment.done
                rows, parameters = rows[going], parameters[going]
                latent, state = latent[going], state[going]
            if not len(rows):
                break
        return [Score(float(total), int(made)) for total, made in zip(fitness, steps, strict=True)]
