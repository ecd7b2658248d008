"""A bundle's dream: where it begins, how it goes on, what a step is worth."""

from __future__ import annotations

import io
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import DREAM, INITIAL, Bundle
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.worker.dream.noise import Draw
from dreamfleet.worker.worldmodel.inference import Dream, DreamStep

Floats = NDArray[np.float32]

TILE_REWARD = 3.5  # of a new tile, on average: CarRacing gives 1000 / N for each of a track's N tiles
IDLE_COST = 0.1  # of each step, as in CarRacing


class Moment(NamedTuple):
    """What one dreamed step gives, a row a dreamer."""

    latent: Floats
    state: Floats
    reward: NDArray[np.float64]
    done: NDArray[np.bool_]


class DreamWorld:
    """The frozen MDN-RNN as a world, at one temperature (Ha & Schmidhuber 2018, section 4)."""

    def __init__(self, bundle: Bundle, temperature: float) -> None:
        check_temperature(temperature)
        if DREAM not in bundle.manifest.parts:
            raise BundleError(f"{bundle.path.name} is from before dreams: build it again with `dreamfleet bundle`")
        self._kind = str(bundle.manifest.models.get("mdnrnn", {}).get("reward", "none"))
        if self._kind == "none":
            raise BundleError(f"{bundle.path.name} predicts no reward: nothing can be scored in its dream")
        self._step = DreamStep(bundle)
        self._temperature = temperature
        self.chance = self._step.chance
        self.initial = read_initial(bundle)

    def begin(self, rows: int) -> Floats:
        """The recurrent state `(rows, state)` before a first step."""
        return self._step.zero_state(rows)

    def live(self, latent: Floats, parameters: Floats, state: Floats, draw: Draw) -> Moment:
        """Controllers `parameters` `(rows, size)` act on `latent` `(rows, latent)` and `state`; the dream goes on."""
        step = self._step.step
        return self._judge(step(latent, parameters, state, draw.uniform, draw.normal, self._temperature, draw.mask))

    def imagine(self, latent: Floats, action: Floats, state: Floats, draw: Draw) -> Moment:
        """The dream goes on under given actions `(rows, actions)`."""
        step = self._step.imagine
        return self._judge(step(latent, action, state, draw.uniform, draw.normal, self._temperature, draw.mask))

    def _judge(self, dream: Dream) -> Moment:
        told = dream.reward.astype(np.float64)
        if self._kind == "value":
            reward = told
        else:
            tile = told if self._kind == "positive" else 1 - told  # the notebook's head tells of steps without one
            reward = TILE_REWARD * tile - IDLE_COST
        return Moment(dream.latent, dream.state, reward, dream.done > 0.5)


def check_temperature(temperature: float) -> None:
    """`UsageError` unless it is a positive number."""
    if not (temperature > 0 and math.isfinite(temperature)):
        raise UsageError(f"a dream's temperature must be a positive number, not {temperature}")


def read_initial(bundle: Bundle) -> Floats:
    """First latents of recorded drives `(N, 2, latent)`, mu and logvar; an opened bundle has at least one."""
    initial: Floats = np.load(io.BytesIO(bundle.read(INITIAL)), allow_pickle=False).astype(np.float32)
    return initial
