"""A drive by somebody's hand under disturbed actions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.scoring.disturbance import Disturbance
from dreamfleet.worker.scoring.hand import Hand
from dreamfleet.worker.scoring.spells import Spells
from dreamfleet.worker.worldmodel.mind import Mind

Floats = NDArray[np.float32]


class Disturbed:
    """A policy: the hand chooses, the disturbance changes it, and all minds are told what was done in truth."""

    def __init__(
        self, hand: Hand, disturbance: Disturbance, watching: Mind | None = None, spells: Spells | None = None
    ) -> None:
        """`watching` is another mind than the hand's that looks on, if one does."""
        self._hand, self._disturbance, self._spells = hand, disturbance, spells
        minds = [watching, None if hand.mind is watching else hand.mind]
        self._minds = [each for each in minds if each is not None]

    def begin(self, _parameters: Any = None) -> None:
        """Begin an episode; the hand has its parameters."""
        for each in self._minds:
            each.begin()

    def act(self, observation: Any) -> Floats:
        """The disturbed action `(actions,)`."""
        for each in self._minds:
            each.see(observation)
        push, chosen = self._disturbance.next(), self._hand.choose(observation)
        action = self._disturbance.apply(chosen, push)
        action = self._spells.apply(chosen, action) if self._spells else action
        self.note(action, push)
        for each in self._minds:
            each.remember(action, chosen)
        done: Floats = action[0]
        return done

    def note(self, action: Floats, push: Floats) -> None:
        """Hear of an action `(1, actions)`, and what of it was the disturbance, before any mind remembers it."""

    def reward(self, value: float) -> None:
        """What the action brought."""
        for each in self._minds:
            each.reward(value)
