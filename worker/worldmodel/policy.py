"""The policy of a world model: a picture becomes a latent, the controller acts on it, and the MDN-RNN remembers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.worker.worldmodel.inference import PolicyStep


class ModelPolicy:  # docs/explanation/sources.md
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

    def side_by_side(self) -> ModelPolicies:
        """The same policy for several controllers at once, each with a state of its own."""
        return ModelPolicies(self._step)


class ModelPolicies:
    """Several controllers, one a row: one call of the world model takes less time than a call for each of them."""

    def __init__(self, step: PolicyStep) -> None:
        self._step = step
        self._parameters = np.zeros((0, step.shape.size), dtype=np.float32)
        self._state = step.zero_state(0)

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode for each row of `parameters` `(rows, size)`; `ControllerError` for another size."""
        for each in parameters:
            self._step.shape.check(each)
        self._parameters = parameters.astype(np.float32)
        self._state = self._step.zero_state(len(parameters))

    def act(self, observations: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The actions `(rows, actions)` for pictures `(rows, side, side, 3)`."""
        action, self._state, _ = self._step.step(observations, self._parameters, self._state)
        return action

    def reward(self, values: NDArray[np.float64]) -> None:
        """Record the rewards `(rows,)` of the last actions, which some models see in the next step."""
        self._step.write_rewards(self._state, values)

    def keep(self, rows: Sequence[int]) -> None:
        """Go on with these rows alone."""
        self._parameters, self._state = self._parameters[rows], self._state[rows]
