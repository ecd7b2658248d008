"""A bundle's dream: its start, its steps, their rewards, and its end."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.world_facts import DRAWN, EndRule, RewardFacts
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.worker.dream.noise import Bars, Draw
from dreamfleet.worker.dream.start_states import StartStates
from dreamfleet.worker.tasks.api import Assignment, World
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.worldmodel.inference import DreamOutput, DreamStep

Floats = NDArray[np.float32]


class DreamEnds:
    """The ends of all dreams of a bundle at one temperature.

    >>> from dreamfleet import find_bundle
    >>> DreamEnds(find_bundle("tiny"), temperature=1.0, text="drawn").rule
    EndRule(kind='drawn', at=0.5, odds_weight=1.0)
    """

    def __init__(self, bundle: Bundle, temperature: float, text: str = "") -> None:
        """`text` is a rule in place of the bundle's, as in `EndRule.parse`; empty: the bundle's own."""
        self.rule = bundle.manifest.world.end
        if text:
            self.rule = replace(EndRule.parse(text), odds_weight=self.rule.odds_weight)
        self.bars: Bars | None = None  # for the dreams' noise; thresholds need none
        if self.rule.kind == DRAWN:
            self.bars = partial(self.rule.bars, temperature=temperature)

    def are_reached(self, predicted: Floats, bar: Floats | None) -> NDArray[np.bool_]:
        """Whether each dream ends `(N,)`, by predicted probabilities `(N,)` and the bars `(N, 1)` of the step's draw.

        Without bars, which every `EpisodeNoise` with drawn ends has, the threshold decides.
        """
        reached: NDArray[np.bool_] = predicted > (np.float32(self.rule.at) if bar is None else bar[:, 0])
        return reached


class DreamtStep(NamedTuple):
    """The result of a dreamt step, one row a dream; `action` is the one that led here."""

    latent: Floats
    state: Floats
    reward: NDArray[np.float64]
    done: NDArray[np.bool_]
    action: Floats


class DreamWorld:
    """The frozen MDN-RNN as a world, at one temperature (Ha and Schmidhuber 2018, section 4)."""

    def __init__(self, bundle: Bundle, temperature: float, recorded: float = 0.0, end: str = "") -> None:
        """`recorded` is the share of `StartStates`, `end` a rule in place of the bundle's, as in `EndRule.parse`.

        `BundleError` if its model does not predict the reward of a dream.
        """
        check_temperature(temperature)
        model: dict[str, Any] = bundle.manifest.models.get("mdnrnn", {})
        self._reward_kind = str(model.get("reward", "none"))
        self._reward_scale = float(model.get("reward_scale", 1.0))  # of a value: what its labels were divided by
        facts = bundle.manifest.world
        self.actions, self.action_names = bundle.driving.controls, facts.action_names
        self.frames_per_second = facts.frames_per_second
        self._reward = _predicted_reward(bundle, self._reward_kind)
        self._step = DreamStep(bundle)
        self._ends = DreamEnds(bundle, temperature, end)
        self.temperature = temperature
        self.chance, self.bars = self._step.chance, self._ends.bars
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
        dream = step(latent, parameters, state, draw.uniform, draw.normal, self.temperature, draw.mask)
        return self._make_step(dream, draw)

    def imagine(
        self, latent: Floats, action: Floats, state: Floats, draw: Draw, chosen: Floats | None = None
    ) -> DreamtStep:
        """One step under given actions `(rows, actions)`; `chosen` are the controllers' own, if those differ."""
        step = self._step.imagine
        dream = step(latent, action, state, draw.uniform, draw.normal, self.temperature, draw.mask, chosen)
        return self._make_step(dream, draw)

    def _make_step(self, dream: DreamOutput[Floats], draw: Draw) -> DreamtStep:
        reward, done = self.judge(dream.reward, dream.done, draw.bar)
        return DreamtStep(dream.latent, dream.state, reward, done, dream.action)

    def judge(self, reward: Floats, done: Floats, bar: Floats | None) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The reward of each dream's step and whether it ends `(N,)`, by the heads' outputs `(N,)`; `bar` of a draw."""
        ended = self._ends.are_reached(done, bar)
        value = self._value(reward.astype(np.float64), ended)
        return np.asarray(self._reward.gain * value - self._reward.cost), ended

    def _value(self, predicted: NDArray[np.float64], done: NDArray[np.bool_]) -> NDArray[np.float64]:
        if self._reward.source == "survival":
            return (~done).astype(np.float64)
        if self._reward.source == "value":
            return predicted * self._reward_scale
        return 1 - predicted if self._reward_kind == "notebook" else predicted  # its head: steps without a reward


def _predicted_reward(bundle: Bundle, kind: str) -> RewardFacts:
    """The reward of a dreamt step; `BundleError` if it is no survival, and no reward head of `kind` predicts it."""
    found = bundle.manifest.world.reward
    survives = found.source == "survival"
    if kind == "none" and not survives:
        raise BundleError(f"{bundle.path.name} predicts no reward: its dreams cannot be scored")
    if not survives and (found.source == "value") != (kind == "value"):
        raise BundleError(
            f"the reward in dreams of {bundle.path.name} is a {found.source}, which its reward head {kind!r} does not "
            "predict: build it again"
        )
    return found


def world_of(bundle: Bundle) -> World:
    """The world of the task that a bundle was trained on."""
    return task_of(bundle).world_of(Assignment.of(bundle.manifest.task, bundle))


def check_temperature(temperature: float) -> None:
    """`UsageError` unless it is a positive number."""
    if not (temperature > 0 and math.isfinite(temperature)):
        raise UsageError(f"a dream's temperature must be a positive number, not {temperature}")
