"""Runs beside each other: settings that differ, scores for equal spending, and what their differences are worth.

Every run evaluates its means on the same validation tracks, and confirms what it reports on the same fresh ones. So
two runs' scores share what is luck with tracks, their standard errors say little about a difference, and it is told
track by track (`common/difference.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from dreamfleet.common.difference import Difference
from dreamfleet.common.effort import Effort
from dreamfleet.common.errors import UsageError
from dreamfleet.common.fields import written
from dreamfleet.common.runs import RunFolder
from dreamfleet.common.stored import RunSettings, StoredConfirmation, unfolded
from dreamfleet.coordinator.learning import LearningCurve, Point
from dreamfleet.coordinator.start import effort_of

Scores = dict[int, float]  # by validation seed


@dataclass(frozen=True)
class Look:
    """An evaluated mean: its generation, what had been spent by then, and its scores."""

    generation: int
    point: Point
    scores: Scores


@dataclass(frozen=True)
class Side:
    """One run, as it is compared; its looks oldest first."""

    name: str
    settings: RunSettings
    world: str | None  # that its evaluations drive; `None` where nothing was evaluated
    total: Effort
    looks: tuple[Look, ...]
    confirmed: StoredConfirmation | None
    confirmed_scores: Scores

    @classmethod
    def of(cls, run: RunFolder) -> Side:
        """From its journal."""
        with run.at_one_moment():
            return cls._read(run)

    @classmethod
    def _read(cls, run: RunFolder) -> Side:
        evaluations, confirmed = run.evaluations(), run.confirmation()
        curve = LearningCurve.of(run) if evaluations else None
        looks = tuple(
            Look(each.generation, point, run.scores(each.generation))
            for each, point in zip(evaluations, curve.points if curve else (), strict=True)
        )
        scores = {} if confirmed is None else run.scores(confirmed.generation, confirming=True)
        world = None if curve is None else curve.world
        return cls(run.name, run.settings, world, effort_of(run), looks, confirmed, scores)

    def at(self, spent: Callable[[Effort], float], most: float) -> Look | None:
        """The last look that had spent no more; whether it was a lucky one played no part in that choice."""
        return next((each for each in reversed(self.looks) if spent(each.point.effort) <= most), None)


@dataclass(frozen=True)
class Equal:
    """The looks of every run once each had spent so much, in the order of the runs."""

    what: str
    spent: float
    looks: tuple[Look | None, ...]


BUDGETS: dict[str, Callable[[Effort], float]] = {
    "steps in reality": lambda effort: effort.steps,
    "core-hours": lambda effort: effort.core_hours,
}


def differing(sides: Sequence[Side]) -> dict[str, list[Any]]:
    """The settings in which the runs differ: of each one a value a run, `None` where it has its default."""
    flat = [_flat(unfolded(written(each.settings))) for each in sides]
    names = sorted({name for each in flat for name in each})
    rows = {name: [each.get(name) for each in flat] for name in names}
    return {name: values for name, values in rows.items() if any(value != values[0] for value in values)}


def at_equal_spending(sides: Sequence[Side]) -> list[Equal]:
    """What each run had learnt once all had spent as much as the thriftiest one had at its last look."""
    found = []
    for what, spent in BUDGETS.items():
        if all(each.looks for each in sides):
            most = min(spent(each.looks[-1].point.effort) for each in sides)
            found.append(Equal(what, most, tuple(each.at(spent, most) for each in sides)))
    return found


def difference(one: Scores, other: Scores) -> Difference | str:
    """Of the `other` less the `one`, or why there is none."""
    try:
        return Difference.of(one, other)
    except UsageError:
        return "no difference can be told: fewer than 2 seeds are in both"


def _flat(plain: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in plain.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
