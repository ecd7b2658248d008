"""A bundle's dream: its start, its steps, and their rewards."""

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
    """The result of a dreamt step, one row a dream; `action` is the one that led here."""

    latent: Floats
    state: Floats
    reward: NDArray[np.float64]
    done: NDArray[np.bool_]
    action: Floats


class DreamWorld:
    """The frozen MDN-RNN as a world, at one temperature (Ha and Schmidhuber 2018, section 4)."""

    def __init__(
        self, bundle: Bundle, temperature: float, world: World | None = None, recorded: float = 0.0
    ) -> None:  # fmt: skip
        """`world` is the bundle's; by default it is looked up. `recorded` is the share of `StartStates`.

        `BundleError` if the bundle cannot dream, or if the rewards of its dream are unknown.
        """
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
            raise BundleError(f"task {bundle.manifest.task} defines no reward for a dreamt step of {bundle.path.name}")
        self._step = DreamStep(bundle)
        self._temperature = temperature
        self.chance = self._step.chance
        self.memory_size = self._step.memory_size
        self.start_states = StartStates.of(bundle, recorded, self._step.zero_state(1)[0, : self.memory_size])

    def begin(self, rows: int, memory: Floats | None = None) -> Floats:
        """The state `(rows, state)` before the first step, with the model's memory empty or `memory` `(rows, memory)`.

        The controllers' memory of their own choices is empty either way.
        """
        state = self._step.zero_state(rows)
        if memory is not None:
            state[:, : self.memory_size] = memory
        return state

    def step_controllers(self, latent: Floats, parameters: Floats, state: Floats, draw: Draw) -> DreamtStep:
        """One step in which controllers `parameters` `(rows, size)` act on `latent` `(rows, latent)` and `state`."""
        step = self._step.step
        return self._make_step(step(latent, parameters, state, draw.uniform, draw.normal, self._temperature, draw.mask))

    def imagine(
        self, latent: Floats, action: Floats, state: Floats, draw: Draw, chosen: Floats | None = None
    ) -> DreamtStep:
        """One step under given actions `(rows, actions)`; `chosen` are the controllers' own, if those differ."""
        step = self._step.imagine
        return self._make_step(
            step(latent, action, state, draw.uniform, draw.normal, self._temperature, draw.mask, chosen)
        )

    def _make_step(self, dream: DreamOutput) -> DreamtStep:
        reward = dream.reward.astype(np.float64)
        if self._dream_reward is not None and self._reward_kind != "value":
            reward = self._label_reward(reward, self._dream_reward, dream)
        return DreamtStep(dream.latent, dream.state, reward, dream.done > 0.5, dream.action)

    def _label_reward(
        self, predicted: NDArray[np.float64], terms: DreamReward, dream: DreamOutput
    ) -> NDArray[np.float64]:
        if terms.source == "survival":
            label = (dream.done <= 0.5).astype(np.float64)
        else:  # the notebook's head predicts steps without a reward
            label = predicted if self._reward_kind == "positive" else 1 - predicted
        return np.asarray(terms.gain * label - terms.cost)


def world_of(bundle: Bundle) -> World:
    """The world of the task that a bundle was trained on."""
    return find_task(bundle.manifest.task).world_of(Assignment.of(bundle.manifest.task, bundle))


def check_temperature(temperature: float) -> None:
    """`UsageError` unless it is a positive number."""
    if not (temperature > 0 and math.isfinite(temperature)):
        raise UsageError(f"a dream's temperature must be a positive number, not {temperature}")
