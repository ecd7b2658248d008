"""The dream as a task: candidates are scored in it, many at once; what is reported is driven in reality."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.messages import TaskSpec
from dreamfleet.worker.car_racing.task import CarRacing
from dreamfleet.worker.dream.batch import Dreamer
from dreamfleet.worker.worldmodel.inference import Controllers, DreamStep

WIDTH = 256  # rows of a batch: larger ones are no faster
Floats = NDArray[np.float32]


class Dream:
    """The task `dream`."""

    name = "dream"
    width = WIDTH

    def __init__(self) -> None:
        self.reality = CarRacing()

    def make_environment(self, bundle: Bundle) -> gymnasium.Env[Any, Any]:
        """CarRacing with the native picture: evaluations are driven, not dreamt."""
        return self.reality.make_environment(bundle)

    def make_judge(self, bundle: Bundle) -> gymnasium.Env[Any, Any]:
        """The unmodified CarRacing of gymnasium."""
        return self.reality.make_judge(bundle)

    def make_policy(self, bundle: Bundle) -> Any:
        """The policy that drives."""
        return self.reality.make_policy(bundle)

    def make_batch(self, bundle: Bundle, spec: TaskSpec) -> Dreamer:
        """What scores candidates."""
        self.reality.preprocessing(bundle)
        return Dreamer(bundle, spec)


class DreamPolicy:
    """A controller inside a dream environment: it observes the latent, and remembers as the dream does."""

    def __init__(self, bundle: Bundle) -> None:
        self._controllers, self._step = Controllers(bundle), DreamStep(bundle)
        self._state = self._step.zero_state(1)
        self._parameters = np.zeros((1, self._step.shape.size), dtype=np.float32)

    def begin(self, parameters: Floats) -> None:
        """Begin an episode with this controller's flat vector."""
        self._step.shape.check(parameters)
        self._parameters = parameters.astype(np.float32).reshape(1, -1)
        self._state = self._step.zero_state(1)

    def act(self, observation: Floats) -> Floats:
        """Steering, gas and brake `(3,)` for one latent."""
        latent = observation[None]
        action = self._controllers.act(self._parameters, latent, self._state)
        self._state = self._step.advance(latent, action, self._state)
        chosen: Floats = action[0]
        return chosen
