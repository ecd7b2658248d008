"""CarRacing's facts, and its variants: a controller's actions and features, penalties on time and on leaving the road.

A variant is the task's options. A run's specification names only options that differ from their defaults, so the
default variant has the specification of a run that names none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar, Literal, Self

from dreamfleet.common.artifacts.actions import (
    FIVE_CHOICES,
    STEERING_AND_HALVES,
    STEERING_GAS_BRAKE,
    STEERING_GAS_BRAKE_AS_THEY_ARE,
    Continuous,
)
from dreamfleet.common.artifacts.task_options import read_options
from dreamfleet.common.artifacts.world_driving import Driving
from dreamfleet.common.artifacts.world_facts import RewardFacts, WorldFacts
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES

CAR_RACING = "car-racing"  # the task; its dream has the same options
FACTS = WorldFacts.of(
    STEERING_GAS_BRAKE,
    packages=NUMERIC_PACKAGES,
    horizon=1000,  # as gymnasium has it
    frames_per_second=50,
    reward=RewardFacts("label", gain=3.5, cost=0.1),  # a tile gives 1000 / N, of a track's N tiles: 3.5 on average
    score_word="track",
    marks=(800.0, 900.0),
    action_names=("steer", "gas", "brake"),
)


@dataclass(frozen=True)
class Variant(Driving):
    """How a controller drives, and the penalties of its candidates; `UsageError` for a value out of range."""

    HELP: ClassVar[dict[str, str]] = {
        "actions": "continuous, or linear or discrete with pedals=two",
        "pedals": "two, half or one",
        "pedal_shift": "a number from -1 to 1, and 0 unless pedals=one",
        **Driving.HELP,
        "time_cost": "a number from 0 to 100",
        "offroad_cost": "a number from 0 to 100",
    }
    WHOSE: ClassVar[str] = f"{CAR_RACING}'s "
    COSTS: ClassVar[tuple[str, ...]] = ("time_cost", "offroad_cost")  # options by which candidates pay

    # linear: the outputs are the action, without tanh; discrete: one of gymnasium's five
    actions: Literal["continuous", "linear", "discrete"] = "continuous"
    pedals: Literal["two", "half", "one"] = "two"  # half: output 0 presses both halfway; one: > 0 is gas, < 0 brake
    pedal_shift: float = 0.0  # added to the one pedal
    time_cost: float = 0.0  # a candidate's penalty for each step before its lap is over
    offroad_cost: float = 0.0  # a candidate's penalty for each step with a wheel off the road

    def _valid(self) -> dict[str, bool]:
        return super()._valid() | {
            "actions": self.actions == "continuous"
            or (self.actions in ("linear", "discrete") and self.pedals == "two"),
            "pedals": self.pedals in ("two", "half", "one"),
            "pedal_shift": _within(self.pedal_shift, -1, 1) and (self.pedals == "one" or not self.pedal_shift),
            "time_cost": _within(self.time_cost, 0, 100),
            "offroad_cost": _within(self.offroad_cost, 0, 100),
        }

    @classmethod
    @lru_cache
    def from_json(cls, options: str) -> Variant:
        """Parse a specification's options, a JSON object or an empty text; `UsageError` lists the known options."""
        found = cls(**read_options(CAR_RACING, options, cls.HELP))
        shift, time, offroad = map(float, (found.pedal_shift, found.time_cost, found.offroad_cost))
        return replace(found, pedal_shift=shift, time_cost=time, offroad_cost=offroad)

    @property
    def version(self) -> int:
        """Version of the task: a worker that does not know variants must not score one as the default."""
        if self.is_default:
            return 1
        # In version 2 the default controls had other penalties.
        return 3 if self.without_costs.is_default else 2

    @property
    def without_costs(self) -> Self:
        """This variant without penalties, on which a controller's parameters do not depend."""
        return replace(self, time_cost=0.0, offroad_cost=0.0)

    @property
    def controls(self) -> Continuous:
        """The conversion of outputs to steering, gas and brake."""
        if self.actions == "discrete":
            return FIVE_CHOICES
        if self.actions == "linear":
            return STEERING_GAS_BRAKE_AS_THEY_ARE
        if self.pedals == "two":
            return STEERING_GAS_BRAKE
        if self.pedals == "half":
            return STEERING_AND_HALVES
        shift = (0.0, self.pedal_shift, -self.pedal_shift)
        return Continuous((1, 1, -1), shift, low=(-1, 0, 0), high=(1, 1, 1), output_indices=(0, 1, 1))


def _within(value: Any, low: float, high: float) -> bool:
    return type(value) in (int, float) and low <= value <= high
