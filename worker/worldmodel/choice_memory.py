"""What controllers keep of their own choices from step to step, and how those of a variant choose.

It lies in columns behind the world model's state, and so goes wherever a state goes: rows leave a batch with theirs,
and a dream that begins at a step of a drive holds on to what the drive held.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.car_racing_variants import Variant

Floats = NDArray[np.float32]
Layer = tuple[Floats, Floats]


class ChoiceMemory:
    """Columns `(N, columns)`: the last choice, the one before it, and the steps that the last one was held.

    There are none where each step is decided anew and no choice is seen.
    """

    def __init__(self, variant: Variant) -> None:
        self._every, self._actions = variant.decide_every, variant.controls
        self._size = self._actions.actions
        self.extra_features = variant.extra_features > 0  # whether they are features too
        self.columns = 2 * self._size + 1 if self.extra_features or self._every > 1 else 0

    def features(self, state: Floats) -> Floats:
        """What a controller sees of them `(N, 2 * outputs)`: the last choice, and its change from the one before."""
        last, before = (self._actions.to_outputs(each) for each in (self._last(state), self._before(state)))
        return np.concatenate([last, last - before], axis=1)

    def choose(self, state: Floats, decide_anew: Callable[[], Floats]) -> Floats:
        """The choice of each row `(N, actions)`: `decide_anew` where it is time to, else the one that is held."""
        if not self.columns:
            return decide_anew()
        due = state[:, -1:] == 0
        if not due.any():
            return np.ascontiguousarray(self._last(state))
        return np.where(due, decide_anew(), self._last(state))

    def next_columns(self, state: Floats, chosen: Floats) -> Floats:
        """The columns after a step at which this was the choice."""
        before = np.where(state[:, -1:] == 0, self._last(state), self._before(state))
        held = (state[:, -1:] + 1) % self._every
        return np.concatenate([chosen, before, held], axis=1)

    def _last(self, state: Floats) -> Floats:
        return state[:, -self.columns : -self._size - 1]

    def _before(self, state: Floats) -> Floats:
        return state[:, -self._size - 1 : -1]


def compute_actions(layers: Sequence[Layer], features: Floats, actions: Continuous) -> Floats:
    """The action `(N, actions)` of controllers, a row each, on `features` (N, F).

    A layer is weights `(N, outputs, inputs)` and biases `(N, outputs)`; between two there are tanh units. Each row is a
    product of its own, so that its bits do not depend on its batch.
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
