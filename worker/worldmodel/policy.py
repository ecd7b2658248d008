"""The policy of a world model: a picture becomes a latent, the controller acts on it, and the MDN-RNN remembers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.worker.worldmodel.inference import PolicyStep


class ModelPolicy:
    """A controller on latent and hidden state. The state advances at every step, also when an action is repeated.

    The MDN-RNN was trained on every step: if steps were skipped, it would misjudge speeds.

    >>> from dreamfleet import find_bundle, find_controller
    >>> policy = ModelPolicy(find_bundle("tiny"))
    >>> policy.begin(find_controller("tiny").parameters)
    >>> policy.act(np.zeros((64, 64, 3), np.uint8)).shape
    (3,)
    """

    def __init__(self, bundle: Bundle) -> None:
        self._step = PolicyStep(bundle)
        self._parameters = np.zeros((1, self._step.shape.size), dtype=np.float32)
        self.state = self._step.zero_state(1)
        self.latent = np.zeros((1, bundle.manifest.latent), dtype=np.float32)

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode with a controller's parameters `(size,)`: zero state; `ControllerError` for another size."""
        self._step.shape.check(parameters)
        self._parameters = parameters.astype(np.float32).reshape(1, -1)
        self.state = self._step.zero_state(1)

    def act(self, observation: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The action `(actions,)` for one picture `(side, side, 3)`."""
        action, self.state, self.latent = self._step.step(observation[None], self._parameters, self.state)
        chosen: NDArray[np.float32] = action[0]
        return chosen

    def reward(self, value: float) -> None:
        """Record the reward of the last action, which some models see in the next step."""
        self._step.write_rewards(self.state, np.array([value]))
