"""How controllers drive: what they may choose in any world, and what its world model's facts say of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Self

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.artifacts.task_options import write_options
from dreamfleet.common.artifacts.world_facts import WorldFacts
from dreamfleet.common.errors import UsageError


@dataclass(frozen=True)
class Driving:
    """How controllers drive: their actions, how long they hold one, and what they see beside the world model's state.

    The options are the fields that `HELP` names. `UsageError` for a value out of range.
    """

    HELP: ClassVar[dict[str, str]] = {"decide_every": "a whole number from 1 to 50", "feedback": "none or last"}
    WHOSE: ClassVar[str] = ""  # options they are, in an error

    decide_every: int = field(default=1, kw_only=True)  # steps for which an action is repeated: docs/reference/tasks.md
    # last: the last action and its change are features too
    feedback: Literal["none", "last"] = field(default="none", kw_only=True)

    def __post_init__(self) -> None:
        for name, is_valid in self._valid().items():
            if not is_valid:
                raise UsageError(f"{self.WHOSE}{name} must be {self.HELP[name]}, not {getattr(self, name)!r}")

    def _valid(self) -> dict[str, bool]:
        return {
            "decide_every": type(self.decide_every) is int and 1 <= self.decide_every <= 50,
            "feedback": self.feedback in ("none", "last"),
        }

    @property
    def controls(self) -> Continuous:
        """The conversion of a controller's outputs to actions."""
        raise NotImplementedError

    @property
    def version(self) -> int:
        """Version of the task under these options."""
        raise NotImplementedError

    @property
    def without_costs(self) -> Self:
        """The same without penalties, on which a controller's parameters do not depend."""
        return self

    @property
    def extra_features(self) -> int:
        """Number of features beside the world model's: with feedback, each output's last value and its change."""
        return 2 * self.controls.outputs if self.feedback == "last" else 0

    @property
    def is_default(self) -> bool:
        """Whether no option differs from its default."""
        return not self._changed

    @property
    def options(self) -> str:
        """The options that differ from the defaults as canonical JSON; empty if none does."""
        return write_options(self._changed)

    @property
    def option_texts(self) -> tuple[str, ...]:
        """The options that differ from the defaults, each as NAME=VALUE."""
        return tuple(f"{name}={value}" for name, value in self._changed.items())

    @property
    def _changed(self) -> dict[str, Any]:
        values = {name: getattr(self, name) for name in self.HELP}
        return {name: value for name, value in values.items() if value != getattr(type(self), name)}


@dataclass(frozen=True)
class WorldDriving(Driving):
    """How controllers drive in a world that its world model describes.

    >>> from dreamfleet.common.artifacts.actions import one_hot
    >>> facts = WorldFacts.of(one_hot(3), packages=("numpy",), horizon=525, frames_per_second=9)
    >>> WorldDriving(facts, decide_every=4, feedback="last").options
    '{"decide_every": 4, "feedback": "last"}'
    """

    facts: WorldFacts

    @property
    def controls(self) -> Continuous:
        """The world's actions."""
        return self.facts.actions

    @property
    def version(self) -> int:
        """Version of the world."""
        return self.facts.version
