"""CarRacing-v3, seen through the world model's encoder."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from common.bundle import Bundle
from common.errors import BundleError
from worker.render.check import make_car_racing
from worker.tasks.preprocessing import PREPROCESSING, SIZE, picture
from worker.worldmodel.inference import PolicyStep

ENVIRONMENT = "CarRacing-v3"


class CarRacing:
    """The task `car-racing`."""

    name = "car-racing"
    width = 1

    def make_environment(self) -> gymnasium.Env[Any, Any]:
        """The environment with the native picture, where that is exact; it observes the 64x64 picture."""
        return make_car_racing(picture_only=True)

    def make_judge(self) -> gymnasium.Env[Any, Any]:
        """The unmodified environment of gymnasium, preprocessed here."""
        return PictureObservation(gymnasium.make(ENVIRONMENT))

    def make_policy(self, bundle: Bundle) -> CarRacingPolicy:
        """Encoder, controller and MDN-RNN of a bundle that was trained on this task's pictures."""
        self.check(bundle)
        return CarRacingPolicy(bundle)

    def check(self, bundle: Bundle) -> None:
        """`BundleError` unless the bundle was trained on this task's pictures."""
        manifest = bundle.manifest
        if (manifest.task, manifest.preprocessing) != (self.name, PREPROCESSING):
            raise BundleError(
                f"bundle {manifest.name} is of task {manifest.task!r}, preprocessing {manifest.preprocessing!r}; "
                f"{self.name} needs {PREPROCESSING!r}"
            )


class PictureObservation(gymnasium.ObservationWrapper[NDArray[np.uint8], Any, NDArray[np.uint8]]):
    """CarRacing's observation as the 64x64x3 picture of `worker.tasks.preprocessing`."""

    def __init__(self, environment: gymnasium.Env[Any, Any]) -> None:
        super().__init__(environment)
        self.observation_space = spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)

    def observation(self, observation: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture."""
        return picture(observation)


class CarRacingPolicy:
    """A controller on latent and hidden state; the state advances with every action."""

    def __init__(self, bundle: Bundle) -> None:
        self._step = PolicyStep(bundle)
        self._parameters = np.zeros((1, self._step.shape.size), dtype=np.float32)
        self.state = self._step.zero_state(1)
        self.latent = np.zeros((1, bundle.manifest.latent), dtype=np.float32)

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode: zero state."""
        self._step.shape.check(parameters)
        self._parameters = parameters.astype(np.float32).reshape(1, -1)
        self.state = self._step.zero_state(1)

    def act(self, observation: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Steering, gas and brake `(3,)` for one picture."""
        action, self.state, self.latent = self._step.step(observation[None], self._parameters, self.state)
        chosen: NDArray[np.float32] = action[0]
        return chosen

    def reward(self, value: float) -> None:
        """What the last action brought; some models see it in the next step."""
        self._step.remember(self.state, np.array([value]))
