"""Conversions of a controller's outputs to an environment's actions."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural

Floats = NDArray[np.float32]
Integers = NDArray[np.int64]
MAX_OUTPUTS = 4096  # of a controller, and components of an action
MOST_CHOICES = 64  # that a table of all actions holds; more have a group of outputs


@dataclass(frozen=True)
class Continuous:
    """Continuous actions `clip(scale * tanh(x) + shift, low, high)` of outputs `x`.

    Action `i` reads output `i`, or `output_indices[i]` where these are given; several actions may share an output.
    `choices` are a fixed set of actions with one output each: the action is the choice with the largest output (the
    first of equal ones), and no output is squashed. `groups` are several choices at once, each with the numbers of its
    outputs and of the action's columns: the column of a group's largest output is 1, its others are 0. A group of two
    outputs may have one column, which is 1 for the second. Without `squashed` an action is the outputs themselves: the
    environment limits what it does with them to `low` to `high`, and a world model sees them as they are.

    >>> import numpy as np
    >>> from dreamfleet import Continuous
    >>> actions = Continuous.between(low=[-1, 0], high=[1, 1])
    >>> actions.to_action(np.array([0, 100], np.float32))
    array([0., 1.], dtype=float32)
    >>> from dreamfleet.common.artifacts.actions import grouped
    >>> grouped([3, 2]).to_action(np.array([0, 5, 1, 7, 2], np.float32))
    array([0., 1., 0., 1., 0.], dtype=float32)
    """

    scale: tuple[float, ...]
    shift: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    output_indices: tuple[int, ...] = ()
    choices: tuple[tuple[float, ...], ...] = ()
    squashed: bool = True
    groups: tuple[tuple[int, int], ...] = ()

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
        if self.groups:
            return sum(self.sizes)
        return max(self.output_indices) + 1 if self.output_indices else self.actions

    @property
    def actions(self) -> int:
        """Number of components of an action."""
        return len(self.scale)

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many values each of an action's numbers has, if its actions are numbered: of the choice, or of groups."""
        return (len(self.choices),) if self.choices else tuple(outputs for outputs, _ in self.groups)

    def from_numbers(self, numbers: Any) -> Floats:
        """The actions `(..., actions)` that the numbers `(..., len(sizes))` choose, each from 0 to its size - 1."""
        found = np.asarray(numbers, dtype=np.int64)
        if self.choices:
            chosen: Floats = self._choice_table[found[..., 0]]
            return chosen
        layout = self.group_layout
        outputs = np.zeros((*found.shape[:-1], self.outputs), np.float32)
        np.put_along_axis(outputs, found + layout.starts, np.float32(1), axis=-1)
        return outputs[..., layout.kept]

    def to_numbers(self, action: Floats) -> Integers:
        """The numbers `(..., len(sizes))` of numbered actions `(..., actions)`; of a vector between them, the nearest.

        >>> one_hot(3).to_numbers(np.array([0, 1, 0], np.float32)).tolist()
        [1]
        """
        if self.choices:
            distances = ((action[..., None, :] - self._choice_table) ** 2).sum(axis=-1)
            nearest: Integers = np.argmin(distances, axis=-1)[..., None]
            return nearest
        return self.group_layout.largest(self.to_outputs(action))

    def to_action(self, logits: Floats) -> Floats:
        """The actions `(..., actions)` of the sums in a controller's last layer `(..., outputs)`."""
        if self.choices:
            chosen: Floats = self._choice_table[np.argmax(logits, axis=-1)]
            return chosen
        if self.groups:
            return self.from_numbers(self.group_layout.largest(logits))
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
        With `choices` the result is one-hot, and with `groups` each group's.
        """
        if self.choices:
            chosen: Floats = (action[..., None, :] == self._choice_table).all(axis=-1).astype(np.float32)
            return chosen
        if self.groups:
            both: Floats = np.concatenate([action, 1 - action], axis=-1)[..., self.group_layout.order]
            return both
        if not self.output_indices:
            return action
        outputs = np.zeros((*action.shape[:-1], self.outputs), np.float32)
        for index, (output, scale) in enumerate(zip(self.output_indices, self.scale, strict=True)):
            outputs[..., output] += np.copysign(np.float32(1), np.float32(scale)) * action[..., index]
        return outputs

    @cached_property
    def group_layout(self) -> GroupLayout:
        """Where the outputs of the groups are."""
        return GroupLayout(self.groups)

    @cached_property
    def _choice_table(self) -> Floats:
        return np.array(self.choices, np.float32)

    @cached_property
    def _ranges(self) -> list[Floats]:
        return [np.array(each, np.float32) for each in (self.scale, self.shift, self.low, self.high)]


class GroupLayout:
    """The places of groups of outputs, G of at most L outputs, among all outputs O and an action's columns A."""

    def __init__(self, groups: tuple[tuple[int, int], ...]) -> None:
        sizes = np.array([outputs for outputs, _ in groups], np.int64)
        self.starts: Integers = np.array([0, *accumulate(sizes)][:-1], np.int64)  # (G,)
        steps = np.arange(sizes.max(initial=0))
        self.real: NDArray[np.bool_] = steps < sizes[:, None]  # (G, L)
        self.places: Integers = np.where(self.real, self.starts[:, None] + steps, 0)  # (G, L)
        dropped = [start for start, (outputs, columns) in zip(self.starts, groups, strict=True) if outputs > columns]
        self.kept: Integers = np.setdiff1d(np.arange(sizes.sum()), dropped)  # (A,), outputs that have a column
        # (O,), of the columns of an action and of 1 minus it: the first of two outputs is 1 where the column is 0.
        self.order: Integers = np.searchsorted(self.kept, np.arange(sizes.sum()))
        self.order[dropped] += len(self.kept)

    def largest(self, outputs: Floats) -> Integers:
        """The number of the largest output of each group `(..., G)`, the first of equal ones, of outputs `(..., O)`."""
        found: Integers = np.argmax(np.where(self.real, outputs[..., self.places], -np.inf), axis=-1)
        return found


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
                f"a mirror of {plural(len(self.signs), 'sign')} orders the columns 0 to {len(self.signs) - 1}, "
                f"not {self.order}"
            )

    def apply(self, action: Floats) -> Floats:
        """The mirrored actions `(..., actions)`; `UsageError` for another number of columns."""
        if action.shape[-1:] != (len(self.order),):
            raise UsageError(
                f"a mirror of {plural(len(self.order), 'column')} does not fit actions of shape {action.shape}"
            )
        mirrored: Floats = action[..., self.order] * np.array(self.signs, np.float32)
        return mirrored


def grouped(sizes: Sequence[int], bits: Collection[int] = ()) -> Continuous:
    """Actions of several numbers, each chosen by a group of outputs; `UsageError` for more than `MAX_OUTPUTS` outputs.

    A number has as many values as its size, and as many columns. The numbers at the indices `bits` have one column.
    """
    if not 1 <= min(sizes) <= sum(sizes) <= MAX_OUTPUTS:
        raise UsageError(f"numbered actions have 1 to {MAX_OUTPUTS} outputs together, not {sum(sizes)}")
    groups = tuple((int(size), 1 if index in bits else int(size)) for index, size in enumerate(sizes))
    width = sum(columns for _, columns in groups)
    return replace(Continuous.between([0.0] * width, [1.0] * width), groups=groups)


def one_hot(count: int) -> Continuous:
    """Actions of which one of `count` is chosen: the action is that row of the identity matrix `(count, count)`.

    `UsageError` for a count below 1 or above `MAX_OUTPUTS`.

    >>> import numpy as np
    >>> one_hot(3).to_action(np.array([0.1, 0.9, 0.2], np.float32))
    array([0., 1., 0.], dtype=float32)
    """
    if count < 1:
        raise UsageError(f"a choice is among at least one action, not {count}")
    if count > MOST_CHOICES:
        return grouped([count])
    rows = tuple(tuple(float(row == column) for column in range(count)) for row in range(count))
    return replace(Continuous.between([0.0] * count, [1.0] * count), choices=rows)


# hardmaru/WorldModelsExperiments, carracing: steering tanh; gas (tanh + 1) / 2; brake clip(tanh, 0, 1).
STEERING_GAS_BRAKE = Continuous(scale=(1, 0.5, 1), shift=(0, 0.5, 0), low=(-1, 0, 0), high=(1, 1, 1))
# AppliedDataSciencePartners/WorldModels, controller/arch.py, and the notebook after it: gas and brake (tanh + 1) / 2.
STEERING_AND_HALVES = Continuous.between(low=(-1, 0, 0), high=(1, 1, 1))
# ctallec/world-models, models/controller.py: no tanh; the car limits its controls.
STEERING_GAS_BRAKE_AS_THEY_ARE = replace(Continuous.between(low=(-1, 0, 0), high=(1, 1, 1)), squashed=False)
# gymnasium's CarRacing-v3 with continuous=False: nothing, right, left, gas, brake; docs/lab/baselines.md.
FIVE_CHOICES = replace(
    STEERING_GAS_BRAKE, choices=((0, 0, 0), (0.6, 0, 0), (-0.6, 0, 0), (0, 0.2, 0), (0, 0, 0.8))
)  # fmt: skip
