"""Conversions of a controller's outputs to an environment's actions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Continuous:
    """Continuous actions `clip(scale * tanh(x) + shift, low, high)` of outputs `x`.

    Action `i` reads output `i`, or `output_indices[i]` where these are given; several actions may share an output.
    `choices` are a fixed set of actions with one output each: the action is the choice with the largest output (the
    first of equal ones), and no output is squashed. Without `squashed` an action is the outputs themselves: the
    environment limits what it does with them to `low` to `high`, and a world model sees them as they are.

    >>> import numpy as np
    >>> from dreamfleet import Continuous
    >>> actions = Continuous.between(low=[-1, 0], high=[1, 1])
    >>> actions.to_action(np.array([0, 100], np.float32))
    array([0., 1.], dtype=float32)
    """

    scale: tuple[float, ...]
    shift: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    output_indices: tuple[int, ...] = ()
    choices: tuple[tuple[float, ...], ...] = ()
    squashed: bool = True

    @classmethod
    def between(cls, low: Any, high: Any) -> Continuous:
        """Map outputs to the range from `low` to `high`, both `(actions,)`; an output of 0 is its middle."""
        low, high = (np.asarray(each, dtype=np.float64).reshape(-1) for each in (low, high))
        ranges = ((high - low) / 2, (high + low) / 2, low, high)
        scale, shift, lowest, highest = (tuple(map(float, each)) for each in ranges)
        return cls(scale, shift, lowest, highest)

    @property
    def outputs(self) -> int:
        """Number of outputs that a controller has."""
        if self.choices:
            return len(self.choices)
        return max(self.output_indices) + 1 if self.output_indices else self.actions

    @property
    def actions(self) -> int:
        """Number of components of an action."""
        return len(self.scale)

    def to_action(self, logits: Floats) -> Floats:
        """The actions `(..., actions)` of the sums in a controller's last layer `(..., outputs)`."""
        if self.choices:
            chosen: Floats = self._choice_table[np.argmax(logits, axis=-1)]
            return chosen
        if not self.squashed:
            return logits.astype(np.float32)
        scale, shift, low, high = self._ranges
        outputs = np.tanh(logits)
        selected = outputs[..., self.output_indices] if self.output_indices else outputs
        action: Floats = np.clip(selected * scale + shift, low, high).astype(np.float32)
        return action

    def to_outputs(self, action: Floats) -> Floats:
        """The outputs `(..., outputs)` that represent actions `(..., actions)` as features.

        Actions that share an output are added, each with the sign of its scale: gas minus brake for a single pedal.
        With `choices` the result is one-hot.
        """
        if self.choices:
            chosen: Floats = (action[..., None, :] == self._choice_table).all(axis=-1).astype(np.float32)
            return chosen
        if not self.output_indices:
            return action
        outputs = np.zeros((*action.shape[:-1], self.outputs), np.float32)
        for index, (output, scale) in enumerate(zip(self.output_indices, self.scale, strict=True)):
            outputs[..., output] += np.copysign(np.float32(1), np.float32(scale)) * action[..., index]
        return outputs

    @cached_property
    def _choice_table(self) -> Floats:
        return np.array(self.choices, np.float32)

    @cached_property
    def _ranges(self) -> list[Floats]:
        return [np.array(each, np.float32) for each in (self.scale, self.shift, self.low, self.high)]


@dataclass(frozen=True)
class Discrete:
    """A choice among `outputs` numbered actions: the largest output wins, the first of equal ones.

    >>> import numpy as np
    >>> from dreamfleet import Discrete
    >>> int(Discrete(3).to_action(np.array([0.1, 0.9, 0.2])))
    1
    """

    outputs: int
    first: int = 0  # the environment's number of the first action

    def to_action(self, logits: Floats) -> np.int64:
        """The action's number."""
        return np.int64(self.first + int(np.argmax(logits)))


Actions = Continuous | Discrete


@dataclass(frozen=True)
class Mirror:
    """The action in the left-right mirrored world: its column `i` is column `order[i]` of the action times `signs[i]`.

    `UsageError` if `order` does not name each column once, or `signs` has another length.

    >>> import numpy as np
    >>> Mirror(order=(0, 2, 1), signs=(1, 1, 1)).apply(np.array([[0, 1, 0], [1, 0, 0]], np.float32))
    array([[0., 0., 1.],
           [1., 0., 0.]], dtype=float32)
    """

    order: tuple[int, ...]
    signs: tuple[float, ...]

    def __post_init__(self) -> None:
        if sorted(self.order) != list(range(len(self.signs))):
            raise UsageError(
                f"a mirror of {len(self.signs)} signs orders the columns 0 to {len(self.signs) - 1}, not {self.order}"
            )

    def apply(self, action: Floats) -> Floats:
        """The mirrored actions `(..., actions)`; `UsageError` for another number of columns."""
        if action.shape[-1:] != (len(self.order),):
            raise UsageError(f"a mirror of {len(self.order)} columns does not fit actions of shape {action.shape}")
        mirrored: Floats = action[..., self.order] * np.array(self.signs, np.float32)
        return mirrored


def one_hot(count: int) -> Continuous:
    """Actions of which one of `count` is chosen: the action is that row of the identity matrix `(count, count)`.

    `UsageError` for a count below 1.

    >>> import numpy as np
    >>> one_hot(3).to_action(np.array([0.1, 0.9, 0.2], np.float32))
    array([0., 1., 0.], dtype=float32)
    """
    if count < 1:
        raise UsageError(f"a choice is among at least one action, not {count}")
    rows = tuple(tuple(float(row == column) for column in range(count)) for row in range(count))
    return replace(Continuous.between([0.0] * count, [1.0] * count), choices=rows)


# hardmaru/WorldModelsExperiments, carracing: steering tanh; gas (tanh + 1) / 2; brake clip(tanh, 0, 1).
STEERING_GAS_BRAKE = Continuous(scale=(1, 0.5, 1), shift=(0, 0.5, 0), low=(-1, 0, 0), high=(1, 1, 1))
# AppliedDataSciencePartners/WorldModels, controller/arch.py, and the notebook after it: gas and brake (tanh + 1) / 2.
STEERING_AND_HALVES = Continuous.between(low=(-1, 0, 0), high=(1, 1, 1))
# ctallec/world-models, models/controller.py: no tanh; the car limits its controls.
STEERING_GAS_BRAKE_AS_THEY_ARE = replace(Continuous.between(low=(-1, 0, 0), high=(1, 1, 1)), squashed=False)
# gymnasium's CarRacing-v3 with continuous=False: nothing, right, left, gas, brake.
FIVE_CHOICES = replace(
    STEERING_GAS_BRAKE, choices=((0, 0, 0), (0.6, 0, 0), (-0.6, 0, 0), (0, 0.2, 0), (0, 0, 0.8))
)  # fmt: skip
