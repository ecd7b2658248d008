"""How the controllers of a world model drive: variants of CarRacing, and what every other world has of these."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, Literal, Protocol

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.car_racing_variants import CAR_RACING, FACTS, Variant
from dreamfleet.common.artifacts.task_options import read_options, write_options
from dreamfleet.common.artifacts.world_facts import RewardFacts, WorldFacts
from dreamfleet.common.errors import UsageError
from dreamfleet.common.schema.validation import MalformedError

__all__ = [
    "FIRST_WORLD",
    "Driving",
    "Variant",
    "WorldDriving",
    "facts_left_out",
    "parse_driving",
]  # every world's options are among a variant's

FIRST_WORLD = CAR_RACING  # the task of files that name none, and the default
OPTION_HELP = {"decide_every": "a whole number from 1 to 50", "feedback": "none or last"}


class Driving(Protocol):
    """How controllers drive: their actions, how long they hold one, and what they see beside the world model's state.

    >>> from dreamfleet.common.artifacts.car_racing_variants import FACTS
    >>> driving: Driving = parse_driving("car-racing", FACTS, '{"feedback": "last"}')
    >>> driving.controls.outputs, driving.extra_features, driving.option_texts
    (3, 6, ('feedback=last',))
    """

    @property
    def controls(self) -> Continuous:
        """The conversion of a controller's outputs to actions."""

    @property
    def decide_every(self) -> int:
        """Steps for which an action is repeated."""

    @property
    def extra_features(self) -> int:
        """Number of features beside the world model's."""

    @property
    def is_default(self) -> bool:
        """Whether no option differs from its default."""

    @property
    def without_costs(self) -> Driving:
        """The same without penalties, on which a controller's parameters do not depend."""

    @property
    def options(self) -> str:
        """The options that differ from the defaults as canonical JSON; empty if none does."""

    @property
    def option_texts(self) -> tuple[str, ...]:
        """The options that differ from the defaults, each as NAME=VALUE."""

    @property
    def version(self) -> int:
        """Version of the task under these options."""


@dataclass(frozen=True)
class WorldDriving:
    """How controllers drive in a world that its world model describes; `UsageError` for a value out of range.

    >>> from dreamfleet.common.artifacts.actions import one_hot
    >>> facts = WorldFacts.of(one_hot(3), packages=("numpy",), horizon=525, frames_per_second=9)
    >>> WorldDriving(facts, decide_every=4, feedback="last").options
    '{"decide_every": 4, "feedback": "last"}'
    """

    facts: WorldFacts
    decide_every: int = 1
    feedback: Literal["none", "last"] = "none"  # last: the last action and its change are features too

    def __post_init__(self) -> None:
        valid = {
            "decide_every": type(self.decide_every) is int and 1 <= self.decide_every <= 50,
            "feedback": self.feedback in ("none", "last"),
        }
        for name, is_valid in valid.items():
            if not is_valid:
                raise UsageError(f"{name} must be {OPTION_HELP[name]}, not {getattr(self, name)!r}")

    @property
    def controls(self) -> Continuous:
        """The world's actions."""
        return self.facts.actions

    @property
    def extra_features(self) -> int:
        """Each output's last value and its change, with feedback."""
        return 2 * self.controls.outputs if self.feedback == "last" else 0

    @property
    def is_default(self) -> bool:
        """Whether no option differs from its default."""
        return not self._non_default

    @property
    def without_costs(self) -> WorldDriving:
        """This: such a world has no penalties."""
        return self

    @property
    def options(self) -> str:
        """The options that differ from the defaults as canonical JSON; empty if none does."""
        return write_options(self._non_default)

    @property
    def option_texts(self) -> tuple[str, ...]:
        """The options that differ from the defaults, each as NAME=VALUE."""
        return tuple(f"{name}={value}" for name, value in self._non_default.items())

    @property
    def version(self) -> int:
        """Version of the world."""
        return self.facts.version

    @property
    def _non_default(self) -> dict[str, Any]:
        values = {
            each.name: (getattr(self, each.name), each.default) for each in fields(self) if each.name in OPTION_HELP
        }
        return {name: value for name, (value, default) in values.items() if value != default}


def facts_left_out(task: str, predicted: object) -> WorldFacts:
    """The facts of CarRacing, whose manifests leave them out; `MalformedError` for another task.

    Its dreams pay what the model has `predicted` if that is the value, or else by the label of a reward.
    """
    if task != CAR_RACING:
        raise MalformedError(f"it does not describe the world of {task}")
    return replace(FACTS, reward=RewardFacts()) if predicted == "value" else FACTS


def parse_driving(task: str, facts: WorldFacts, options: str) -> Driving:
    """How controllers of a world model drive under a run's options, a JSON object or an empty text.

    `task` and `facts` are of the world model's manifest; CarRacing has more options than other worlds. `UsageError` for
    options that the world does not have.

    >>> from dreamfleet.common.artifacts.car_racing_variants import FACTS
    >>> parse_driving("car-racing", FACTS, '{"pedals": "one"}').controls.outputs
    2
    """
    if task == CAR_RACING:
        return Variant.from_json(options)
    return _parse_options(task, facts, options)


@lru_cache
def _parse_options(task: str, facts: WorldFacts, options: str) -> WorldDriving:
    return WorldDriving(facts, **read_options(task, options, OPTION_HELP))
