"""Short spells of what a driver never does, so that what follows it is in the data."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous

Floats = NDArray[np.float32]
SHORTEST, LONGEST = 3, 15  # steps: 0.06 to 0.3 s of a car at 50 steps a second


class ActionBursts:
    """An action that rests at a bound, where noise leaves it, is now and then set to any value of its range.

    It is held for some steps, all as likely. A function of the seed and of what is chosen.
    """

    def __init__(self, seed: int, actions: Continuous, chance: float) -> None:
        """`chance` is a resting action's, at each step, that a spell begins."""
        self._random = np.random.default_rng([seed, 1])
        self._low, self._high = np.array(actions.low, np.float32), np.array(actions.high, np.float32)
        self._chance = chance
        self._value = np.zeros(actions.actions, np.float32)
        self._left = np.zeros(actions.actions, np.int64)

    def apply(self, chosen: Floats, done: Floats) -> Floats:
        """What is done instead `(1, actions)` of what would be `done` where this is chosen."""
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
