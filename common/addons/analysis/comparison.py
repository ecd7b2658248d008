"""Compare runs: differing settings, scores at an equal budget, and paired differences of scores.

All runs evaluate their means on the same validation tracks and confirm reports on the same fresh ones. Luck with tracks
is therefore common to both scores and cancels in a difference per track (`common/runs/paired_difference.py`).
Pages: dashboard.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from dreamfleet.common.addons.analysis.learning import Point, points_of, world_of
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.function_values import is_minimised, value_of
from dreamfleet.common.protocol.tasks import is_function_task
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.paired_difference import PairedDifference
from dreamfleet.common.runs.records import RunSettings, StoredConfirmation, in_values
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.schema.validation import to_plain

Scores = dict[int, float]  # by validation seed


@dataclass(frozen=True)
class EvaluatedMean:
    """An evaluated mean of the search: its generation, the effort spent until then, and its scores."""

    generation: int
    point: Point
    scores: Scores


@dataclass(frozen=True)
class ComparedRun:
    """One side of a comparison; `evaluated_means` oldest first."""

    name: str
    settings: RunSettings
    world: str | None  # task of the evaluations; `None` before the first
    total: Effort  # with what was inherited
    inherited: Effort  # spent on the run's start: by the run that it forked, or on the controller
    evaluated_means: tuple[EvaluatedMean, ...]
    confirmed: StoredConfirmation | None
    confirmed_scores: Scores

    @classmethod
    def of(cls, run: RunFolder) -> ComparedRun:
        """Read a run's journal."""
        with run.verified_transaction():
            evaluations, confirmed = run.evaluations(), run.confirmation()
            evaluated_means = tuple(
                EvaluatedMean(each.generation, point, run.scores(each.generation))
                for each, point in zip(evaluations, points_of(run, as_values=False), strict=True)
            )
            scores = {} if confirmed is None else run.scores(confirmed.generation, confirming=True)
            world = world_of(run) if evaluations else None
            return cls(
                run.name, run.settings, world, run.total_effort(), run.start_effort(),
                evaluated_means, confirmed, scores,
            )  # fmt: skip

    @property
    def in_values(self) -> ComparedRun:
        """The same with the values of a minimised function as its means; what is paired by seed stays its fitness."""
        task = self.settings.task
        if not self.minimised:
            return self
        means = tuple(
            replace(each, point=replace(each.point, score=value_of(each.point.score, task)))
            for each in self.evaluated_means
        )
        return replace(self, evaluated_means=means, confirmed=in_values(self.confirmed, task))

    @property
    def minimised(self) -> bool:
        """Whether it is of a function that is minimised."""
        return is_minimised(self.settings.task)

    @property
    def spent(self) -> str:
        """What was spent in all, and which part of it before the run began, in words."""
        task = self.settings.task.task
        before = f" ({self.inherited.describe(task)} of it inherited)" if self.inherited != Effort() else ""
        return f"{self.total.describe(task)}{before}"

    def last_within_budget(self, spent: Callable[[Effort], float], most: float) -> EvaluatedMean | None:
        """The last evaluated mean within the budget. Its score plays no part in the choice, so luck does not either."""
        return next((each for each in reversed(self.evaluated_means) if spent(each.point.effort) <= most), None)


@dataclass(frozen=True)
class EqualBudget:
    """Each run's last evaluated mean within the same budget, in the order of the runs."""

    what: str
    spent: float
    evaluated_means: tuple[EvaluatedMean | None, ...]


STATISTICS = "task.options.normal."  # mean and deviation of observations, as a run began
STEPS, CORE_HOURS = "steps in reality", "core-hours"
BUDGETS: dict[str, Callable[[Effort], float]] = {
    STEPS: lambda effort: effort.steps,
    CORE_HOURS: lambda effort: effort.core_hours,
}


def differing_settings(sides: Sequence[ComparedRun]) -> dict[str, list[Any]]:
    """The settings that differ, each with one value a run; `None` is the default."""
    return differing_values([to_plain(each.settings) for each in sides])


def differing_values(sides: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """What differs between plain settings, by dotted name; of --normalise not the statistics that each side has."""
    flat = [_flatten(expand_task_options(each)) for each in sides]
    names = sorted({name for each in flat for name in each})
    rows = {name: [each.get(name) for each in flat] for name in names}
    return {
        name: values
        for name, values in rows.items()
        if any(value != values[0] for value in values) and not (name.startswith(STATISTICS) and None not in values)
    }


def expand_task_options(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Plain settings for display: the task's JSON options parsed, and the controller's shape only once."""
    task = dict(settings.get("task", {}))
    with suppress(ValueError):
        task["options"] = json.loads(task.get("options") or "{}")
    if task.get("controller") == settings.get("controller"):
        task.pop("controller", None)
    return {**settings, "task": task}


def are_comparable(sides: Sequence[ComparedRun]) -> bool:
    """Whether their scores are of one world, and if that is a function, of one direction."""
    return len({(each.world, each.minimised) for each in sides if each.world is not None}) == 1


def at_equal_budget(sides: Sequence[ComparedRun]) -> list[EqualBudget]:
    """Each run's result at the smallest budget of all runs, for each kind of budget; empty without evaluations."""
    found = []
    for what, spent in BUDGETS.items():
        if all(each.evaluated_means for each in sides):
            most = min(spent(each.evaluated_means[-1].point.effort) for each in sides)
            found.append(EqualBudget(what, most, tuple(each.last_within_budget(spent, most) for each in sides)))
    return found


def budget_name(sides: Sequence[ComparedRun], what: str) -> str:
    """A kind of budget in words: a function has calls, and no steps; counts alike: runs/effort.py."""
    return "calls" if what == STEPS and all(is_function_task(each.settings.task.task) for each in sides) else what


def paired_scores(
    sides: Sequence[ComparedRun], equal: Sequence[EqualBudget]
) -> Iterator[tuple[str, ComparedRun, Scores, Scores]]:
    """Scores beside the first run's, at equal budgets, then confirmed: of what, the run, the first's, its own."""
    for number, side in enumerate(sides[1:], 1):
        for each in equal:
            base, look = each.evaluated_means[0], each.evaluated_means[number]
            if base is not None and look is not None:
                yield f"at equal {budget_name(sides, each.what)}", side, base.scores, look.scores
        if sides[0].confirmed is not None and side.confirmed is not None:
            yield "confirmed", side, sides[0].confirmed_scores, side.confirmed_scores


def difference(one: Scores, other: Scores) -> PairedDifference | str:
    """The paired difference `other - one`, or the reason why there is none."""
    try:
        return PairedDifference.of(one, other)
    except UsageError:
        return "no difference: fewer than 2 seeds are in both"


def _flatten(plain: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in plain.items():
        flat |= _flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat
