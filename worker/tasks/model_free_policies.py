"""Policies without a world model: of a controller on flat observations, of a driver, and of a choice that is held."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Actions
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import ControllerError

Floats = NDArray[np.float32]
NO_PARAMETERS = np.zeros(0, np.float32)  # of agents without any
ALL_DRIVERS = "random"  # as a driver's name: all drivers of a task in turn


class FlatPolicy:
    """A linear controller, or one with a layer of tanh units, on observations that the run's statistics normalise."""

    def __init__(self, shape: ControllerShape, actions: Actions, mean: Any = 0.0, deviation: Any = 1.0) -> None:
        """`mean` and `deviation` are of the observations, `(observations,)`; `ControllerError` for a wrong size."""
        if shape.actions != actions.outputs:
            raise ControllerError(f"a controller of {shape.actions} outputs does not fit {actions.outputs} actions")
        self._shape, self._actions = shape, actions
        self._mean = np.asarray(mean, dtype=np.float32)
        self._scale = np.float32(1) / np.asarray(deviation, dtype=np.float32)
        self._layers: list[tuple[Floats, Floats]] = []

    def begin(self, parameters: Floats) -> None:
        """Start an episode with a controller's flat parameter vector `(size,)`."""
        self._layers = self._shape.unpack(parameters.astype(np.float32))

    def act(self, observation: Any) -> Any:
        """The action for an observation of any shape."""
        return self._actions.to_action(self.outputs(observation))

    def outputs(self, observation: Any) -> Floats:  # worker/worlds/gym/standalone_play.py computes the same
        """The controller's outputs `(outputs,)` for an observation; the action is made of them."""
        value = (np.asarray(observation, dtype=np.float32).reshape(-1) - self._mean) * self._scale
        *before, (weights, biases) = self._layers
        for each, offsets in before:
            value = np.tanh(each @ value + offsets)
        found: Floats = weights @ value + biases
        return found


class Driver(Protocol):
    """Chooses actions without observations; the first world model learns from such drives."""

    def act(self) -> Floats:
        """The next action."""


class DriverPolicy:
    """A driver as a policy."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    def begin(self, parameters: Floats) -> None:
        """Do nothing: a driver has no parameters."""

    def act(self, _observation: Any) -> Any:
        """The driver's next action."""
        return self._driver.act()


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
