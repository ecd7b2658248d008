"""CarRacing-v3, seen through the world model's encoder."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.errors import BundleError
from dreamfleet.worker.car_racing.check import make_car_racing
from dreamfleet.worker.car_racing.preprocessing import PREPROCESSINGS, Preprocessing
from dreamfleet.worker.worldmodel.inference import PolicyStep

ENVIRONMENT = "CarRacing-v3"


class CarRacing:
    """The task `car-racing`."""

    name = "car-racing"
    width = 1

    def make_environment(self, bundle: Bundle) -> gymnasium.Env[Any, Any]:
        """The environment with the native picture, where that is exact; it observes the bundle's pictures."""
        return make_car_racing(preprocessing=self.preprocessing(bundle).name)

    def make_judge(self, bundle: Bundle, render_mode: str | None = None) -> gymnasium.Env[Any, Any]:
        """The unmodified environment of gymnasium, preprocessed here."""
        preprocessing = self.preprocessing(bundle)
        return PictureObservation(gymnasium.make(ENVIRONMENT, render_mode=render_mode), preprocessing)

    def make_policy(self, bundle: Bundle) -> CarRacingPolicy:
        """Encoder, controller and MDN-RNN of a bundle that was trained on this task's pictures."""
        self.preprocessing(bundle)
        return CarRacingPolicy(bundle)

    def preprocessing(self, bundle: Bundle) -> Preprocessing:
        """What makes the pictures that the bundle was trained on; `BundleError` if this task does not give them."""
        manifest = bundle.manifest
        found = PREPROCESSINGS.get(manifest.preprocessing)
        if manifest.task != self.name or found is None or manifest.picture != found.shape:
            given = " or ".join(f"{each.name!r} {each.shape}" for each in PREPROCESSINGS.values())
            raise BundleError(
                f"bundle {manifest.name} is of task {manifest.task!r} and pictures {manifest.preprocessing!r} "
                f"{manifest.picture}; {self.name} gives {given}"
            )
        return found


class PictureObservation(gymnasium.ObservationWrapper[NDArray[np.uint8], Any, NDArray[np.uint8]]):
    """CarRacing's observation as the picture of a preprocessing."""

    def __init__(self, environment: gymnasium.Env[Any, Any], preprocessing: Preprocessing) -> None:
        super().__init__(environment)
        self._preprocessing = preprocessing
        self.observation_space = spaces.Box(0, 255, preprocessing.shape, np.uint8)

    def observation(self, observation: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture."""
        return self._preprocessing.picture(observation)


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
