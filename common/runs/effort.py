"""The effort of a run: environment steps in reality and in the dream, and slot time. Pages: export.md, results.md."""

from __future__ import annotations

import json
from dataclasses import astuple, dataclass, field

from dreamfleet.common.errors import JournalError
from dreamfleet.common.protocol.result_bounds import clamp_count, to_finite
from dreamfleet.common.protocol.tasks import DREAM, is_function_task
from dreamfleet.common.schema.validation import OPTIONAL, Count, MalformedError, from_plain_lenient

START_EFFORT = "start_effort"  # name of a fact in the journal


@dataclass(frozen=True)
class Effort:
    """The effort of accepted results; lost and repeated work is not counted.

    Whole numbers, so that sums do not depend on the order.
    """

    driven: Count = field(default=0, metadata=OPTIONAL)  # real steps of candidates and collected rollouts
    judged: Count = field(default=0, metadata=OPTIONAL)  # real steps of evaluations and confirmation
    dreamt: Count = field(default=0, metadata=OPTIONAL)  # candidates' steps in the dream
    microseconds: Count = field(default=0, metadata=OPTIONAL)  # slot time

    @classmethod
    def of(cls, task: str, kind: str, steps: float, microseconds: float, *, driven: bool = False) -> Effort:
        """The effort of results of one kind; `driven`: candidates of a dream task were scored in reality."""
        count, time = clamp_count(int(to_finite(steps))), clamp_count(int(to_finite(microseconds)))
        if kind == "evaluate":
            return cls(judged=count, microseconds=time)
        if kind == "score" and task == DREAM and not driven:
            return cls(dreamt=count, microseconds=time)
        return cls(driven=count, microseconds=time)

    def __add__(self, other: Effort) -> Effort:
        pairs = zip(astuple(self), astuple(other), strict=True)
        return Effort(*(clamp_count(one + another) for one, another in pairs))

    @property
    def steps(self) -> int:
        """All steps in reality."""
        return clamp_count(self.driven + self.judged)

    @property
    def core_hours(self) -> float:
        """Slot time in core-hours; a slot uses one core."""
        return self.microseconds / 3.6e9

    def describe(self, task: str) -> str:
        """A text for display, of a run in this task: a function has calls, and no steps."""
        dreamt = f", {format_steps(self.dreamt)} dreamt" if self.dreamt else ""
        steps = "calls" if is_function_task(task) else "steps in reality"  # counts alike: comparison.py, stored_runs.py
        return f"{format_steps(self.steps)} {steps}{dreamt}, {self.core_hours:,.3g} core-hours"


@dataclass(frozen=True)
class GenerationEffort:
    """The effort of one generation; `confirming`: of choosing and confirming the reported mean."""

    generation: int
    confirming: bool
    effort: Effort


def parse_start_effort(kept: str | None) -> Effort | None:
    """Parse the fact `START_EFFORT`: the effort of earlier runs in a run's start; `None` if unknown."""
    try:
        return None if kept is None else from_plain_lenient(Effort, json.loads(kept))
    except (ValueError, MalformedError) as error:
        raise JournalError(f"the journal's effort of the run's start is damaged: {error}; restore it") from error


def format_steps(steps: int) -> str:
    """Format a number of steps: 930, 12k, 2.85M."""
    for unit, name in ((10**9, "G"), (10**6, "M"), (10**3, "k")):
        if steps >= unit:
            return f"{steps / unit:.3g}{name}"
    return str(steps)
