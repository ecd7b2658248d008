"""A bundle's dream: where it begins, how it goes on, what a step is worth."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import DREAM_GRAPH, Bundle
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.worker.dream.noise import Draw
from dreamfleet.worker.dream.start_states import StartStates
from dreamfleet.worker.tasks.api import Assignment, DreamReward, World
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.inference import DreamOutput, DreamStep

Floats = NDArray[np.float32]


class DreamtStep(NamedTuple):
    """What one dreamed step gives, a row a dreamer."""

    latent: Floats
    state: Floats
    reward: NDArray[np.float64]
    done: NDArray[np.bool_]
    action: Floats  # that led here


class DreamWorld:
    """The frozen MDN-RNN as a world, at one temperature (Ha & Schmidhuber 2018, section 4)."""

    def __init__(
        self, bundle: Bundle, temperature: float, world: World | None = None, recorded: float = 0.0
    ) -> None:  # fmt: skip
        """`world` is the bundle's own; found by its name if it is not given. `recorded` is a share of `StartStates`."""
        check_temperature(temperature)
        if DREAM_GRAPH not in bundle.manifest.parts:
            raise BundleError(f"{bundle.path.name} is from before dreams: build it again with `dreamfleet bundle`")
        self.world = world or world_of(bundle)
        self._reward_kind = str(bundle.manifest.models.get("mdnrnn", {}).get("reward", "none"))
        self._dream_reward = self.world.dream_reward
        survival = self._dream_reward is not None and self._dream_reward.source == "survival"
        if self._reward_kind == "none" and not survival:
            raise BundleError(f"{bundle.path.name} predicts no reward: nothing can be scored in its dream")
        if self._reward_kind != "value" and self._dream_reward is None:
            raise BundleError(
                f"task {bundle.manifest.task} does not say what a dreamt step of {bundle.path.name} is worth"
            )
        self._step = DreamStep(bundle)
        self._temperature = temperature
        self.chance = self._step.chance
        self.memory_size = self._step.memory_size
        self.start_states = StartStates.of(bundle, recorded, self._step.zero_state(1)[0, : self.memory_size])

    def begin(self, rows: int, memory: Floats | None = None) -> Floats:
        """The state `(rows, state)` before a first step: empty, or the model's part is `memory` `(rows, memory)`.

        What a controller keeps of its own choices begins anew either way.
        """
        state = self._step.zero_state(rows)
        if memory is not None:
            state[:, : self.memory_size] = memory
        return state

    def step_controllers(self, latent: Floats, parameters: Floats, state: Floats, draw: Draw) -> DreamtStep:
        """Controllers `parameters` `(rows, size)` act on `latent` `(rows, latent)` and `state`; the dream goes on."""
        step = self._step.step
        return self._make_step(step(latent, parameters, state, draw.uniform, draw.normal, self._temperature, draw.mask))

    def imagine(
        self, latent: Floats, action: Floats, state: Floats, draw: Draw, chosen: Floats | None = None
    ) -> DreamtStep:
        """The dream goes on under given actions `(rows, actions)`; `chosen` is a controller's where another is done."""
        step = self._step.imagine
        return self._make_step(
            step(latent, action, state, draw.uniform, draw.normal, self._temperature, draw.mask, chosen)
        )

    def _make_step(self, dream: DreamOutput) -> DreamtStep:
        told = dream.reward.astype(np.float64)
        reward = (
            told
            if self._dream_reward is None or self._reward_kind == "value"
            else self._value(told, self._dream_reward, dream)
        )
        return DreamtStep(dream.latent, dream.state, reward, dream.done > 0.5, dream.action)

    def _value(self, told: NDArray[np.float64], worth: DreamReward, dream: DreamOutput) -> NDArray[np.float64]:
        if worth.source == "survival":
            label = (dream.done <= 0.5).astype(np.float64)
        else:
            label = (
                told if self._reward_kind == "positive" else 1 - told
            )  # the notebook's head tells of steps without one
        return np.asarray(worth.gain * label - worth.cost)


def world_of(bundle: Bundle) -> World:
    """The world that a bundle was trained on."""
    return find_task(bundle.manifest.task).world_of(Assignment.of(bundle.manifest.task, bundle))


def check_temperature(temperature: float) -> None:
    """`UsageError` unless it is a positive number."""
    if not (temperature > 0 and math.isfinite(temperature)):
        raise UsageError(f"a dream's temperature must be a positive number, not {temperature}")
