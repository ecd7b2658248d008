"""A policy that chooses one of a few actions and holds it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


class ChoosingPolicy(ABC):
    """Chooses by a picture, and holds what it chose for `frame_skip` steps."""

    def __init__(self, choices: Sequence[Sequence[float]], frame_skip: int) -> None:
        """`choices` are steering, gas and brake of each."""
        self._table, self._frame_skip = np.array(choices, np.float32), frame_skip
        self._held = 0
        self.choice = 0

    @property
    def decided(self) -> bool:
        """Whether the last action was a new decision, and not one that was held."""
        return self._held == 1

    def begin(self, _parameters: Floats) -> None:
        """Begin an episode: nothing is held, and nothing is remembered."""
        self._held = 0
        self.forget()

    def act(self, observation: NDArray[np.uint8]) -> Floats:
        """Steering, gas and brake `(3,)` for one picture."""
        if self._held in (0, self._frame_skip):
            self.choice, self._held = self.choose(observation), 0
        self._held += 1
        action: Floats = self._table[self.choice]
        return action

    @abstractmethod
    def forget(self) -> None:
        """Be as an episode begins."""

    @abstractmethod
    def choose(self, picture: NDArray[np.uint8]) -> int:
        """The number of the next choice."""
