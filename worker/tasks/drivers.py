"""Random drivers for worlds of any actions, which collect the data of a first world model.

They draw each action evenly: the number of each of its choices, or a number between the bounds of each component.
"""

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous

Floats = NDArray[np.float32]


class UniformActions:
    """Draws another action at every step."""

    def __init__(self, random: np.random.Generator, actions: Continuous) -> None:
        self._random = random
        self._low, self._high = (np.array(each, dtype=np.float32) for each in (actions.low, actions.high))
        self._actions = actions

    def act(self) -> Floats:
        """The next action `(A,)`."""
        if sizes := self._actions.sizes:
            return self._actions.from_numbers([self._random.integers(size) for size in sizes])
        return np.array(self._random.uniform(self._low, self._high), dtype=np.float32)


class HeldActions:
    """Draws an action and holds it for a drawn number of steps, from `shortest` to `longest`."""

    def __init__(self, random: np.random.Generator, actions: Continuous, shortest: int = 1, longest: int = 10) -> None:
        self._random = random
        self._uniform = UniformActions(random, actions)
        self._lengths = shortest, longest
        self._left = 0
        self._action = np.zeros(actions.actions, dtype=np.float32)

    def act(self) -> Floats:
        """The held action `(A,)`, or a new one."""
        if self._left == 0:
            self._action = self._uniform.act()
            self._left = int(self._random.integers(*self._lengths, endpoint=True))
        self._left -= 1
        return self._action.copy()
