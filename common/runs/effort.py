"""What a run's results took: environment steps in reality and in the dream, and time of slots."""

from __future__ import annotations

import json
from dataclasses import dataclass, field

from dreamfleet.common.errors import JournalError
from dreamfleet.common.protocol.result_bounds import clamp_count, to_finite
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.serialization.constraints import Count
from dreamfleet.common.serialization.optional_fields import OPTIONAL, known
from dreamfleet.common.serialization.validation import MalformedError, from_plain

START_EFFORT = "start_effort"  # the name of a run's fact


@dataclass(frozen=True)
class Effort:
    """Of accepted results alone: what was lost with a worker, or done twice, is not in it.

    Whole numbers, so that a sum is the same in any order.
    """

    driven: Count = field(default=0, metadata=OPTIONAL)  # environment steps of candidates and kept rollouts, in reality
    judged: Count = field(default=0, metadata=OPTIONAL)  # environment steps of evaluations and confirmation
    dreamt: Count = field(default=0, metadata=OPTIONAL)  # steps of candidates in the dream
    microseconds: Count = field(default=0, metadata=OPTIONAL)  # that slots worked

    @classmethod
    def of(cls, task: str, kind: str, steps: float, microseconds: float, *, driven: bool = False) -> Effort:
        """Of results of one kind in a run of this task; `driven`: of candidates that did not dream there."""
        told = clamp_count(int(to_finite(steps))), clamp_count(int(to_finite(microseconds)))
        if kind == "evaluate":
            return cls(judged=told[0], microseconds=told[1])
        if kind == "score" and task == DREAM and not driven:
            return cls(dreamt=told[0], microseconds=told[1])
        return cls(driven=told[0], microseconds=told[1])

    def __add__(self, other: Effort) -> Effort:
        return Effort(
            clamp_count(self.driven + other.driven), clamp_count(self.judged + other.judged),
            clamp_count(self.dreamt + other.dreamt), clamp_count(self.microseconds + other.microseconds),
        )  # fmt: skip

    @property
    def steps(self) -> int:
        """All environment steps in reality."""
        return clamp_count(self.driven + self.judged)

    @property
    def core_hours(self) -> float:
        """Hours that one core would have worked; a slot is a core."""
        return self.microseconds / 3.6e9

    @property
    def description(self) -> str:
        """In words."""
        dreamt = f", {format_steps(self.dreamt)} dreamt" if self.dreamt else ""
        return f"{format_steps(self.steps)} steps in reality{dreamt}, {self.core_hours:.3g} core-hours"


@dataclass(frozen=True)
class GenerationEffort:
    """What a run's generation took; `confirming`: the drives of its mean that chose and confirmed the report."""

    generation: int
    confirming: bool
    effort: Effort


def parse_start_effort(kept: str | None) -> Effort | None:
    """What had been spent on a run's start, by the fact that is kept of it; `None` where that is not known."""
    try:
        return None if kept is None else from_plain(Effort, known(Effort, json.loads(kept)))
    except (ValueError, MalformedError) as error:
        raise JournalError(f"what the journal tells of the run's start is damaged: {error}; restore it") from error


def format_steps(steps: int) -> str:
    """A number of steps as it is said: 930, 12k, 2.85M."""
    for unit, name in ((10**9, "G"), (10**6, "M"), (10**3, "k")):
        if steps >= unit:
            return f"{steps / unit:.3g}{name}"
    return str(steps)
