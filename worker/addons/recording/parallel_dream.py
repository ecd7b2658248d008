"""Dreams that start from a real drive: the same controller, continued inside the world model."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.worker.dream.noise import EpisodeNoise
from dreamfleet.worker.dream.world import DreamEnds, check_temperature
from dreamfleet.worker.worldmodel.inference import DreamStep

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class ParallelDreamConfig:
    """Settings of a `ParallelDream`."""

    temperature: float = 1.0
    every: int = 100  # steps until it restarts from the drive: after two seconds a dream has left the real track
    seed: int = 0

    def __post_init__(self) -> None:
        check_temperature(self.temperature)


class DreamContinuation:
    """Dreams that continue any controller's drive from any moment. The model needs no reward head."""

    def __init__(self, bundle: Bundle, temperature: float) -> None:
        check_temperature(temperature)
        self._step, self._ends = DreamStep(bundle), DreamEnds(bundle, temperature)
        self._temperature = temperature

    def make_noise(self, seed: int) -> EpisodeNoise:
        """The random numbers of one dream, or of one after another."""
        return EpisodeNoise(seed, self._step.chance, self._ends.bars)

    def fits(self, latent: Floats, state: Floats, parameters: Floats) -> bool:
        """Whether these flat arrays have the sizes of this world model and its controllers."""
        sizes = self._step.latent_size, self._step.state_size, self._step.shape.size
        return (len(latent), len(state), len(parameters)) == sizes

    def dream(self, latent: Floats, state: Floats, parameters: Floats, noise: EpisodeNoise) -> Iterator[Floats]:
        """Yield the latent `(1, latent)` after each further step, until the model predicts the end.

        All three arrays are flat; `state` is the model's before the action at `latent`.
        """
        latent, state, parameters = latent[None], state[None], parameters[None]
        while True:
            draw = noise.next()
            drawn = draw.uniform, draw.normal, self._temperature, draw.mask
            dream = self._step.step(latent, parameters, state, *drawn)
            latent, state = dream.latent, dream.state
            if self._ends.are_reached(dream.done, draw.bar)[0]:
                return
            yield latent


class ParallelDream:
    """One controller's dream beside its drive, step by step."""

    def __init__(self, bundle: Bundle, parameters: Floats, config: ParallelDreamConfig) -> None:
        self._continuation = DreamContinuation(bundle, config.temperature)
        self._noise = self._continuation.make_noise(config.seed)
        self._parameters, self._every = parameters.astype(np.float32), config.every
        self._following: Iterator[Floats] = iter(())
        self.since = 0  # the step of the drive at which this dream started

    def follow(self, step: int, latent: Floats, state: Floats) -> Floats:
        """The dreamt latent `(1, latent)` for a step of the drive; where a dream starts, the drive's own.

        `latent` `(1, latent)` and `state` `(1, state)` are the drive's at this step, before it acts.
        """
        dreamt = next(self._following, None)
        if dreamt is not None and step - self.since < self._every:
            return dreamt
        self.since = step
        self._following = self._continuation.dream(latent[0].copy(), state[0].copy(), self._parameters, self._noise)
        return latent
