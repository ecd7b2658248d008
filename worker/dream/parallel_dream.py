"""The dream beside a drive: the same controller inside the model, which begins at the drive's own latent."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, Bundle
from dreamfleet.worker.dream.noise import EpisodeNoise
from dreamfleet.worker.dream.world import check_temperature
from dreamfleet.worker.worldmodel.inference import DreamStep

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class ParallelDreamConfig:
    """How it dreams, and after how many steps it looks at the drive again."""

    temperature: float = 1.0
    every: int = 100  # two seconds: by then a dream has left the track that is driven
    seed: int = 0

    def __post_init__(self) -> None:
        check_temperature(self.temperature)


class ParallelDream:
    """One controller's dream, step by step beside its drive; needs no reward head."""

    def __init__(self, bundle: Bundle, parameters: Floats, config: ParallelDreamConfig) -> None:
        self._step = DreamStep(bundle)
        self._noise = EpisodeNoise(config.seed, self._step.chance)
        self._parameters = parameters.astype(np.float32).reshape(1, -1)
        self._config = config
        self._over = True
        self.since = 0  # the step of the drive at which this dream began

    def follow(self, step: int, latent: Floats, state: Floats) -> Floats:
        """The latent `(1, latent)` dreamt for this step of the drive; the drive's own where a dream begins.

        `latent` and `state` are the drive's at this step, before it acts.
        """
        if self._over or step - self.since >= self._config.every:
            self._latent, self._state, self.since = latent, state, step
        dreamt = self._latent
        draw = self._noise.next()
        dream = self._step.step(
            dreamt, self._parameters, self._state, draw.uniform, draw.normal, self._config.temperature, draw.mask
        )
        self._latent, self._state, self._over = dream.latent, dream.state, bool(dream.done[0] > 0.5)
        return dreamt


class DreamContinuation:
    """The dream that goes on from any moment of any controller's drive."""

    def __init__(self, bundle: Bundle, temperature: float) -> None:
        check_temperature(temperature)
        self._step = DreamStep(bundle)
        self._temperature = temperature

    def fits(self, latent: Floats, state: Floats, parameters: Floats) -> bool:
        """Whether these `(size,)` are of this world model and its controllers."""
        sizes = self._step.latent_size, self._step.state_size, self._step.shape.size
        return (len(latent), len(state), len(parameters)) == sizes

    def dream(self, latent: Floats, state: Floats, parameters: Floats, seed: int) -> Iterator[Floats]:
        """The latent `(1, latent)` after each step from there, until the model says that it is over.

        All three `(size,)`; `state` is what was remembered before the action at `latent`.
        """
        noise = EpisodeNoise(seed, self._step.chance)
        latent, state, parameters = latent[None], state[None], parameters[None]
        while True:
            draw = noise.next()
            dream = self._step.step(
                latent, parameters, state, draw.uniform, draw.normal, self._temperature, draw.mask
            )  # fmt: skip
            latent, state = dream.latent, dream.state
            if dream.done[0] > 0.5:
                return
            yield latent


def can_dream(bundle: Bundle) -> bool:
    """Whether the bundle has a step of the dream; those from before it do not."""
    return DREAM_GRAPH in bundle.manifest.parts
