"""A policy that chooses one of a few actions and repeats it for some steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]


class FrameSkipPolicy(ABC):
    """Chooses by a picture, and repeats the choice for `frame_skip` steps."""

    def __init__(self, choices: Sequence[Sequence[float]], frame_skip: int) -> None:
        """`choices`: the action of each choice."""
        self._actions, self._frame_skip = np.array(choices, np.float32), frame_skip
        self._steps_held = 0
        self.choice = 0

    @property
    def is_new_decision(self) -> bool:
        """Whether the last action was a new decision rather than a repeated one."""
        return self._steps_held == 1

    def begin(self, _parameters: Floats) -> None:
        """Begin an episode: drop the held choice and the memory."""
        self._steps_held = 0
        self.reset_memory()

    def act(self, observation: NDArray[np.uint8]) -> Floats:
        """Return the action `(actions,)` for one picture `(side, side, 3)`."""
        if self._steps_held in (0, self._frame_skip):
            self.choice, self._steps_held = self.choose(observation), 0
        self._steps_held += 1
        action: Floats = self._actions[self.choice]
        return action

    @abstractmethod
    def reset_memory(self) -> None:
        """Forget the last episode."""

    @abstractmethod
    def choose(self, picture: NDArray[np.uint8]) -> int:
        """Return the number of the next choice."""
