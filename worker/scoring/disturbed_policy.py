"""A drive by somebody's hand under disturbed actions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.scoring.action_bursts import ActionBursts
from dreamfleet.worker.scoring.actors import Actor
from dreamfleet.worker.scoring.disturbance import Disturbance
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState

Floats = NDArray[np.float32]


class DisturbedPolicy:
    """A policy: the hand chooses, the disturbance changes it, and all minds are told what was done in truth."""

    def __init__(
        self,
        actor: Actor,
        disturbance: Disturbance,
        watching_mind: RecurrentState | None = None,
        bursts: ActionBursts | None = None,
    ) -> None:
        """`watching_mind` is a second recurrent state that observes the drive; `None`: there is none."""
        self._actor, self._disturbance, self._bursts = actor, disturbance, bursts
        minds = [watching_mind, None if actor.mind is watching_mind else actor.mind]
        self._minds = [each for each in minds if each is not None]

    def begin(self, _parameters: Any = None) -> None:
        """Begin an episode; the hand has its parameters."""
        for each in self._minds:
            each.begin()

    def act(self, observation: Any) -> Floats:
        """The disturbed action `(actions,)`."""
        for each in self._minds:
            each.see(observation)
        push, chosen = self._disturbance.next(), self._actor.choose(observation)
        action = self._disturbance.apply(chosen, push)
        action = self._bursts.apply(chosen, action) if self._bursts else action
        self.on_action(action, push)
        for each in self._minds:
            each.advance(action, chosen)
        done: Floats = action[0]
        return done

    def on_action(self, action: Floats, push: Floats) -> None:
        """Hear of an action `(1, actions)`, and what of it was the disturbance, before any mind remembers it."""

    def reward(self, value: float) -> None:
        """What the action brought."""
        for each in self._minds:
            each.reward(value)
