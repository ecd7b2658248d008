"""Actors, which choose the actions of a drive: a controller with its world model."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.worker.worldmodel.inference import Controllers
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState

Floats = NDArray[np.float32]


class Actor(Protocol):
    """Chooses actions. The caller passes observations, actions and rewards to its recurrent state, if it has one."""

    @property
    def recurrent_state(self) -> RecurrentState | None:
        """The state that its choices depend on; `None` if there is none."""

    def choose(self, seen: Any, /) -> Floats:
        """The next action `(1, actions)`; `seen` is the observation, which its recurrent state already has."""


class ControllerActor:
    """A controller, with the recurrent state of the world model that it was evolved in, of its shape and variant."""

    def __init__(self, controller: Controller, bundle: Bundle, recurrent_state: RecurrentState) -> None:
        self._controllers = Controllers(bundle.for_controller(controller))
        self._parameters = controller.parameters.reshape(1, -1)
        self.recurrent_state = recurrent_state

    def choose(self, _seen: Any) -> Floats:
        """The controller's action `(1, actions)` for its recurrent state."""
        state = self.recurrent_state
        return self._controllers.act(self._parameters, state.latent, state.state)
