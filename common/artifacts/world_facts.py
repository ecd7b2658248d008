"""What a world model's manifest says of its world: to begin a run in it needs no package of the world.

Bundles stay readable and score alike: a new field has a default and is OPTIONAL. Pages: dreams.md, takecover.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any, Final, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import MAX_OUTPUTS, Continuous
from dreamfleet.common.errors import UsageError
from dreamfleet.common.schema.validation import OPTIONAL, MalformedError, Word

DRAWN: Final = "drawn"  # the text of the rule that draws its ends (docs/explanation/dreams.md)
ODDS_WEIGHTS: Final = (1e-6, 1e6)  # the least and the most
MAX_OPTIONS = 20_000  # characters of a task's options
# One number for each component of an action
Components = Annotated[tuple[float, ...], Meta(min_length=1, max_length=MAX_OUTPUTS)]


@dataclass(frozen=True)
class RewardFacts:
    """The reward of a dreamt step: `gain * value - cost`, whatever `source` the value has.

    `value`: the reward that the world model predicts. `label`: the probability that its head gives to a positive
    reward. `survival`: 1 while the dream goes on, and 0 as it ends.

    >>> RewardFacts(source="survival", gain=4.0)
    RewardFacts(source='survival', gain=4.0, cost=0.0)
    """

    source: Literal["value", "label", "survival"] = "value"
    gain: float = 1.0
    cost: float = 0.0


@dataclass(frozen=True)
class EndRule:
    """When a dream ends: at the first step whose predicted probability of the end is above that step's bar.

    `threshold`: the bar is `at` at every step. `drawn`: the bar is random, so that a dream ends as often as predicted.
    A model that was trained with ends `odds_weight` times as heavy predicts odds so many times too high: drawn bars
    are higher by as much. `UsageError` for numbers out of range.

    >>> EndRule.parse("drawn").kind, EndRule.parse("0.25").at, EndRule().text
    ('drawn', 0.25, '0.5')
    """

    kind: Literal["threshold", "drawn"] = "threshold"
    at: Annotated[float, Meta(ge=0, le=1)] = 0.5
    odds_weight: Annotated[float, Meta(ge=ODDS_WEIGHTS[0], le=ODDS_WEIGHTS[1])] = field(default=1.0, metadata=OPTIONAL)

    def __post_init__(self) -> None:
        if not 0 <= self.at <= 1:
            raise UsageError(f"a dream ends at a probability from 0 to 1, or {DRAWN!r}, not {self.at}")
        least, most = ODDS_WEIGHTS
        if not least <= self.odds_weight <= most:
            raise UsageError(f"the weight of an end's odds is from {least:g} to {most:g}, not {self.odds_weight}")

    @classmethod
    def parse(cls, text: str) -> EndRule:
        """The rule of a text, `drawn` or a threshold from 0 to 1; `UsageError` for another one."""
        if text == DRAWN:
            return cls(DRAWN)
        try:
            return cls(at=float(text))
        except ValueError:
            raise UsageError(f"a dream ends at a probability from 0 to 1, or {DRAWN!r}, not {text!r:.50}") from None

    @property
    def text(self) -> str:
        """The rule as a text that `parse` reads; without `odds_weight`, which is the model's."""
        return DRAWN if self.kind == DRAWN else str(self.at)

    def bars(self, uniform: NDArray[np.float64], temperature: float) -> NDArray[np.float32]:
        """The bars `(n,)` of steps with the random numbers `uniform` `(n,)` in [0, 1), at a dream's temperature.

        A drawn bar `b` has `p > b` exactly where `sigmoid(logit(p) / temperature) > uniform`. At temperature 1 a dream
        ends with probability `p`; above 1 likely ends come less often, and unlikely ones more often. With `odds_weight`
        the odds of `p` are first divided by it.

        >>> EndRule().bars(np.array([0.1, 0.9]), temperature=2.0)
        array([0.5, 0.5], dtype=float32)
        >>> EndRule("drawn").bars(np.array([0.0, 0.2, 0.5]), temperature=2.0).round(3)
        array([0.   , 0.059, 0.5  ], dtype=float32)
        >>> EndRule("drawn", odds_weight=3.0).bars(np.array([0.2, 0.5]), temperature=1.0).round(3)
        array([0.429, 0.75 ], dtype=float32)
        """
        if self.kind != DRAWN:
            return np.full(len(uniform), self.at, np.float32)
        drawn = np.asarray(uniform, dtype=np.float64)
        with np.errstate(divide="ignore", over="ignore"):  # at 0, or at a high temperature, the bar is 0
            against = ((1 - drawn) / drawn) ** temperature  # the odds
            return (1 / (1 + against / self.odds_weight)).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class WorldFacts:
    """A world as a bundle's manifest describes it.

    `MalformedError` if its actions do not fit together, or a name would control a terminal.

    >>> from dreamfleet.common.artifacts.actions import one_hot
    >>> facts = WorldFacts.of(one_hot(3), packages=("numpy", "onnxruntime"), horizon=525, frames_per_second=9)
    >>> facts.actions == one_hot(3), facts.end.text
    (True, '0.5')
    """

    scale: Components  # this and the next six as in `Continuous`
    shift: Components
    low: Components
    high: Components
    output_indices: tuple[int, ...] = field(default=(), metadata=OPTIONAL)
    choices: tuple[tuple[float, ...], ...] = field(default=(), metadata=OPTIONAL)
    groups: Annotated[tuple[tuple[int, int], ...], Meta(max_length=MAX_OUTPUTS)] = field(default=(), metadata=OPTIONAL)
    packages: Annotated[tuple[Word, ...], Meta(max_length=64)]  # distributions on whose versions a fitness may depend
    horizon: Annotated[int, Meta(ge=1, le=10**6)]  # most steps of an evaluation episode
    frames_per_second: Annotated[int, Meta(ge=1, le=1000)]  # of videos
    reward: RewardFacts = field(default=RewardFacts(), metadata=OPTIONAL)
    end: EndRule = field(default=EndRule(), metadata=OPTIONAL)
    options: Annotated[str, Meta(max_length=MAX_OPTIONS)] = field(default="", metadata=OPTIONAL)  # of the task, frozen
    version: Annotated[int, Meta(ge=1, le=2**31 - 1)] = field(default=1, metadata=OPTIONAL)  # of the task's world
    score_word: Word = field(default="seed", metadata=OPTIONAL)  # what a scored seed is called
    # scores to compare with
    marks: Annotated[tuple[float, ...], Meta(max_length=8)] = field(default=(), metadata=OPTIONAL)
    action_names: Annotated[tuple[Word, ...], Meta(max_length=MAX_OUTPUTS)] = field(default=(), metadata=OPTIONAL)

    def __post_init__(self) -> None:
        size = len(self.scale)
        if not len(self.shift) == len(self.low) == len(self.high) == size:
            raise MalformedError("scale, shift, low and high differ in length")
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise MalformedError("low is above high")
        if self.output_indices and (len(self.output_indices) != size or not _are_all_used(self.output_indices)):
            raise MalformedError("output_indices do not name one output for each component of an action")
        if any(len(choice) != size for choice in self.choices):
            raise MalformedError("a choice has another length than the action")
        if self.groups and not self._are_groups_sound():
            raise MalformedError("groups do not name outputs for each component of an action")
        if len(self.action_names) not in (0, size):
            raise MalformedError(f"it names {len(self.action_names)} actions of {size}")
        if not all(map(str.isprintable, (*self.packages, *self.action_names, self.score_word))):
            raise MalformedError("a name holds control characters")

    @classmethod
    def of(cls, actions: Continuous, **facts: Any) -> WorldFacts:
        """The facts of a world with these actions; `facts` are the other fields.

        `UsageError` for outputs that are not squashed, which only a variant of CarRacing has.
        """
        if not actions.squashed:
            raise UsageError("a world's outputs are squashed by tanh: give `squashed` its default")
        for name in ("scale", "shift", "low", "high"):
            facts[name] = tuple(map(float, getattr(actions, name)))
        choices = tuple(tuple(map(float, choice)) for choice in actions.choices)
        return cls(output_indices=actions.output_indices, choices=choices, groups=actions.groups, **facts)

    def _are_groups_sound(self) -> bool:
        if any(len(each) != 2 for each in self.groups):
            return False
        sizes = [outputs for outputs, _ in self.groups]
        fits = all(columns == outputs or (outputs, columns) == (2, 1) for outputs, columns in self.groups)
        fits = fits and min(sizes) >= 1 and sum(sizes) <= MAX_OUTPUTS and not (self.choices or self.output_indices)
        return fits and sum(columns for _, columns in self.groups) == len(self.scale)

    @cached_property
    def actions(self) -> Continuous:
        """The conversion of a controller's outputs to actions."""
        return Continuous(
            self.scale, self.shift, self.low, self.high, self.output_indices, self.choices, groups=self.groups
        )


def _are_all_used(outputs: tuple[int, ...]) -> bool:
    return sorted(set(outputs)) == list(range(len(set(outputs))))
