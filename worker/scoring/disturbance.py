"""Disturbed drives: noise and bursts on a policy's actions, so that data also show what follows unusual actions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.worker.scoring.actors import Actor
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState

Floats = NDArray[np.float32]
CORRELATION = 0.9  # of the noise from step to step; at 50 steps a second it changes sign within about 0.2 s
SHORTEST, LONGEST = 3, 15  # steps of a burst: 0.06 to 0.3 s at 50 steps a second


class Disturbance:
    """First-order autoregressive noise on actions, a pure function of the seed."""

    def __init__(self, seed: int, actions: Continuous, noise: float) -> None:
        """`noise` is the standard deviation, as a fraction of half an action's range."""
        self._random = np.random.default_rng(seed)
        self._actions = actions
        self._scale = noise * (np.array(actions.high) - np.array(actions.low)) / 2
        self._value = np.zeros(actions.actions)

    def next(self) -> Floats:
        """The noise `(1, actions)` of the next step."""
        fresh = self._random.standard_normal(len(self._value))
        self._value = CORRELATION * self._value + (1 - CORRELATION**2) ** 0.5 * fresh
        push: Floats = (self._value * self._scale).astype(np.float32)[None]
        return push

    def apply(self, chosen: Floats, push: Floats) -> Floats:
        """The chosen actions with the noise `push`, as `add_disturbance`."""
        return add_disturbance(self._actions, chosen, push)


def add_disturbance(actions: Continuous, chosen: Floats, push: Floats) -> Floats:
    """Add the noise `push` to chosen actions `(rows, actions)`, within their bounds.

    An action that rests at a bound stays there; noise on an unused brake would slow down every drive.
    """
    low, high = np.array(actions.low, np.float32), np.array(actions.high, np.float32)
    resting = (chosen <= low) | (chosen >= high)
    done: Floats = np.where(resting, chosen, np.clip(chosen + push, low, high))
    return done


class ActionBursts:
    """Sometimes replaces an action that rests at a bound, which noise leaves alone, by a random value for some steps.

    Value and length of a burst are uniformly distributed. The bursts depend only on the seed and the chosen actions.
    """

    def __init__(self, seed: int, actions: Continuous, chance: float) -> None:
        """`chance` is the probability, at each step and for each resting action, that a burst starts."""
        self._random = np.random.default_rng([seed, 1])
        self._low, self._high = np.array(actions.low, np.float32), np.array(actions.high, np.float32)
        self._chance = chance
        self._value = np.zeros(actions.actions, np.float32)
        self._left = np.zeros(actions.actions, np.int64)

    def apply(self, chosen: Floats, done: Floats) -> Floats:
        """The next actions `(1, actions)`: those `done`, or bursts in their place; `chosen` are before any noise."""
        random, count = self._random, len(self._value)
        begins, lengths = random.random(count), random.integers(SHORTEST, LONGEST, count, endpoint=True)
        values = random.uniform(self._low, self._high).astype(np.float32)
        resting = ((chosen <= self._low) | (chosen >= self._high))[0]
        new = (self._left == 0) & resting & (begins < self._chance)
        self._value, self._left = np.where(new, values, self._value), np.where(new, lengths, self._left)
        under = self._left > 0
        self._left -= under
        tried: Floats = np.where(under, self._value, done[0])[None]
        return tried


class DisturbedPolicy:
    """A policy: an actor chooses, the disturbance changes the action, and recurrent states get the changed action."""

    def __init__(
        self,
        actor: Actor,
        disturbance: Disturbance,
        watching: RecurrentState | None = None,
        bursts: ActionBursts | None = None,
    ) -> None:
        """`watching` is a recurrent state that observes the drive beside the actor's own, if any."""
        self._actor, self._disturbance, self._bursts = actor, disturbance, bursts
        states = [watching, None if actor.recurrent_state is watching else actor.recurrent_state]
        self._states = [each for each in states if each is not None]

    def begin(self, _parameters: Any = None) -> None:
        """Start an episode; the actor already has its parameters."""
        for each in self._states:
            each.begin()

    def act(self, observation: Any) -> Floats:
        """The disturbed action `(actions,)`."""
        for each in self._states:
            each.see(observation)
        push, chosen = self._disturbance.next(), self._actor.choose(observation)
        action = self._disturbance.apply(chosen, push)
        action = self._bursts.apply(chosen, action) if self._bursts else action
        self.on_action(action, push)
        for each in self._states:
            each.advance(action, chosen)
        done: Floats = action[0]
        return done

    def on_action(self, action: Floats, push: Floats) -> None:
        """Called with each action `(1, actions)` and its noise, before the recurrent states advance; for subclasses."""

    def reward(self, value: float) -> None:
        """Pass the reward of the last action to the recurrent states."""
        for each in self._states:
            each.reward(value)
