"""Whether a new world model replaces the old one, by the figures of `inspect` for both.

Three figures, of which more is better. *Knows*: the mean, over the quantities of the simulator's truth, of the R² of a
linear map from [z, h] on held-out drives. *Loses*: how many dreams begun shortly before real losses of the road lose it
too, less how many do where reality loses nothing; reality's is 1. A dream that loses none, or all, has 0.
*Survives*: how well the lengths of dreams of fixed policies agree with those of real episodes; 0 is best.

A new model is refused if a figure that both have is clearly worse: lower by more than two standard errors of the
difference, and by more than `MARGIN`. What could not be measured of both refuses nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dreamfleet.common.runs.standard_error import format_with_error

MARGIN = 0.02
ERRORS = 2.0
KNOWS, LOSES, SURVIVES = FIGURES = "knows", "loses", "survives"
CALM = "no loss"  # as `inspect` names the beginnings behind which reality loses nothing


@dataclass(frozen=True)
class Figure:
    """A measured value and its standard error."""

    value: float
    error: float

    def __str__(self) -> str:
        return format_with_error(self.value, self.error, 2)

    def is_clearly_below(self, other: Figure) -> bool:
        """Whether it is clearly worse than the other one."""
        return other.value - self.value > max(MARGIN, ERRORS * math.hypot(self.error, other.error))


Figures = Mapping[str, Figure | None]
NOTHING = Figure(0.0, 0.0)


@dataclass(frozen=True)
class GateDecision:
    """Whether the new model is kept, and why, in words."""

    kept: bool
    why: str


def judge(old: Figures, new: Figures) -> GateDecision:
    """Compare the new model's figures with the old one's."""
    both = {name: (before, after) for name in FIGURES
            if (before := old.get(name)) is not None and (after := new.get(name)) is not None}  # fmt: skip
    if not both:
        return GateDecision(True, "kept: nothing was measured of both")
    worse = [name for name, (before, after) in both.items() if after.is_clearly_below(before)]
    compared = ", ".join(f"{name} {before} -> {after}" for name, (before, after) in both.items())
    verdict = f"refused, clearly worse in {' and '.join(worse)}" if worse else "kept"
    return GateDecision(not worse, f"{compared}: {verdict}")


def figures(measured: Mapping[str, Any]) -> dict[str, Figure | None]:
    """The figures of a model from what was measured of it: its probe, losses and survival, where it has them."""
    found = {KNOWS: knows(measured.get("probe")), LOSES: loses(measured.get("losses"))}
    return {**found, SURVIVES: survives(measured["survival"])} if "survival" in measured else found


def knows(probe: Any | None) -> Figure | None:
    """Of a `Knowledge`; a quantity below 0 is not known. The error is the mean, as if all erred together."""
    if probe is None:
        return None
    known = [each.found["zh_linear"] for each in probe.known]
    found = [Figure(each.value, each.error) if each.value > 0 else NOTHING for each in known]
    value, error = (sum(getattr(each, name) for each in found) / len(found) for name in ("value", "error"))
    return Figure(value, error)


def loses(losses: Any | None) -> Figure | None:
    """Of a `LossReport`: of the dreams that begin furthest before a loss; `None` without calm ones.

    One beginning of a kind has no standard error, so that it decides nothing: `None` too.
    """
    if losses is None:
        return None
    begun = {each.begun: each.figures["lost"]["dream"] for each in losses.begun}
    before = next((each for name, each in begun.items() if name != CALM), None)
    if before is None or CALM not in begun or None in (before.error, begun[CALM].error):
        return None
    return Figure(before.value - begun[CALM].value, math.hypot(before.error, begun[CALM].error))


def survives(survival: Any | None) -> Figure | None:
    """Of a `Survival`; `None` of one episode, which has no standard error."""
    found = survival and survival.agreement
    return None if found is None or found.error is None else Figure(found.value, found.error)
