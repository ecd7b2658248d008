"""The memory of a controller's last choices, for variants that repeat choices or see them, and their actions.

It is kept in the last columns of the recurrent state. So it moves with the state: when rows leave a batch, and when a
dream begins at a step of a drive. Pages: tasks.md.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.driving import Driving

Floats = NDArray[np.float32]
Layer = tuple[Floats, Floats]


class ChoiceMemory:
    """Columns `(N, columns)` of the state: the last choice, the one before it, and how long the last one was held.

    There are no columns if each step makes a new choice and the controller does not see its choices.
    """

    def __init__(self, driving: Driving) -> None:
        self._every, self._actions = driving.decide_every, driving.controls
        self._size = self._actions.actions
        self.extra_features = driving.extra_features > 0  # whether the controller sees its choices
        self.columns = 2 * self._size + 1 if self.extra_features or self._every > 1 else 0

    def features(self, state: Floats) -> Floats:
        """The controller's inputs from it `(N, 2 * outputs)`: the last choice, and its difference to the one before."""
        last, before = (self._actions.to_outputs(each) for each in (self._last(state), self._before(state)))
        return np.concatenate([last, last - before], axis=1)  # counts alike: worker/addons/card/driver_graph.py

    def choose(self, state: Floats, decide_anew: Callable[[], Floats]) -> Floats:
        """The choice of each row `(N, actions)`: a new one by `decide_anew` where it is due, else the held one."""
        if not self.columns:
            return decide_anew()
        due = state[:, -1:] == 0
        if not due.any():
            return np.ascontiguousarray(self._last(state))
        return np.where(due, decide_anew(), self._last(state))

    def next_columns(self, state: Floats, chosen: Floats) -> Floats:
        """The columns `(N, columns)` after a step with the choice `chosen` `(N, actions)`."""
        before = np.where(state[:, -1:] == 0, self._last(state), self._before(state))
        held = (state[:, -1:] + 1) % self._every
        return np.concatenate([chosen, before, held], axis=1)

    def _last(self, state: Floats) -> Floats:
        return state[:, -self.columns : -self._size - 1]

    def _before(self, state: Floats) -> Floats:
        return state[:, -self._size - 1 : -1]


def compute_actions(layers: Sequence[Layer], features: Floats, actions: Continuous) -> Floats:
    """The actions `(N, actions)` of N controllers, one per row, on `features` (N, F).

    A layer is weights `(N, outputs, inputs)` and biases `(N, outputs)`, with tanh between layers. Each row has its own
    matrix product, so its bits do not depend on the batch.
    """
    *before, last = layers
    value = features
    for layer in before:
        value = np.tanh(_affine(layer, value))
    return actions.to_action(_affine(last, value))


def _affine(layer: Layer, value: Floats) -> Floats:
    weights, biases = layer
    column = np.ascontiguousarray(value).reshape(*value.shape, 1)
    return np.asarray(np.matmul(weights, column)[..., 0] + biases)
