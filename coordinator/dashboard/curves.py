"""What charts draw of a run, live or past: its generations and evaluations as columns. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from dreamfleet.common.effort import Effort, GenerationEffort
from dreamfleet.common.printable import plural
from dreamfleet.common.stages import begun_stages, in_turn, steps_told
from dreamfleet.common.stored import RunSettings, StoredConfirmation, StoredEvaluation, StoredGeneration
from dreamfleet.common.tasks import DREAM
from dreamfleet.common.terms import Agenda

MOST_POINTS = 600  # that are sent and drawn, however long a run is: more than a screen can tell apart
T = TypeVar("T")
Quartiles = Mapping[int, tuple[float, float]]  # by generation


@dataclass(frozen=True)
class Course:
    """What is known of a run's course."""

    settings: RunSettings
    history: Sequence[StoredGeneration]
    evaluations: Sequence[StoredEvaluation]
    confirmed: StoredConfirmation | None


def sampled(rows: Sequence[T]) -> Sequence[T]:
    """Every k-th row and the last one, `MOST_POINTS` or fewer."""
    step = step_of(len(rows))
    kept = rows[::step]
    return [*kept, rows[-1]] if (len(rows) - 1) % step else kept


def step_of(rows: int) -> int:
    """Of how many rows one is kept."""
    return max(math.ceil(rows / (MOST_POINTS - 1)), 1) if rows > MOST_POINTS else 1


def curves(course: Course, quartiles: Quartiles | None, spent: Sequence[Effort] | None = None) -> dict[str, Any]:
    """The columns: `spent` is what a run took up to each generation, its start included.

    Without quartiles the band is one standard deviation about the mean, and says so.
    """
    settings, rows = course.settings, sampled(course.history)
    dreamt = settings.task.task == DREAM
    finished = {each.generation: each for each in course.evaluations}
    stages = begun_stages(settings, course.history, course.evaluations)
    steps = in_turn(steps_told(each.stage.horizon, each.stage.driven, dreamt=dreamt) for each in stages)
    drawn: dict[str, Any] = {
        "step": step_of(len(course.history)),
        "generation": [each.number for each in rows],
        "mean": [_short(each.mean) for each in rows],
        "best": [_short(each.best) for each in rows],
        "low": [_short(low) for low, _ in _band(rows, quartiles)],
        "high": [_short(high) for _, high in _band(rows, quartiles)],
        "band": "± 1 standard deviation" if quartiles is None else "the middle half of the candidates",
        "sigma": [_short(each.sigma) for each in rows],
        "temperature": _temperatures(course, rows, finished),
        "evaluations": _evaluations(course, spent),
        "confirmed": None if course.confirmed is None else _confirmed(course.confirmed, course, spent),
        "stages": [each.since for each in stages[1:]],
        "dreamt": dreamt,
        "fitness_axis": f"fitness over {steps}",
        "score_axis": f"score{' in reality' * dreamt}, {plural(settings.evaluation_episodes, 'whole episode')}",
    }
    if spent is not None:
        drawn |= _spent([spent[each.number] for each in rows if each.number < len(spent)])
    return drawn


def cumulated(start: Effort, efforts: Iterable[GenerationEffort], generations: int) -> list[Effort]:
    """What had been spent after each of so many generations; confirming a report is not among it."""
    by_generation: dict[int, Effort] = {}
    for each in efforts:
        if not each.confirming:
            by_generation[each.generation] = by_generation.get(each.generation, Effort()) + each.effort
    found, total = [], start
    for number in range(generations):
        total += by_generation.get(number, Effort())
        found.append(total)
    return found


def _band(rows: Sequence[StoredGeneration], quartiles: Quartiles | None) -> list[tuple[float, float]]:
    if quartiles is None:
        return [(each.mean - each.std, each.mean + each.std) for each in rows]
    return [quartiles.get(each.number, (each.mean, each.mean)) for each in rows]


def _temperatures(
    course: Course, rows: Sequence[StoredGeneration], finished: Mapping[int, StoredEvaluation]
) -> list[float] | None:
    """At which each generation dreamt; `None` where a task has no temperature."""
    if course.settings.task.temperature is None:
        return None
    agenda = Agenda(course.settings)
    found = [agenda.terms(each.number, course.history, finished).spec.temperature for each in rows]
    return [each for each in found if each is not None]


def _evaluations(course: Course, spent: Sequence[Effort] | None) -> dict[str, Any]:
    rows = sampled(course.evaluations)
    told: dict[str, Any] = {
        "generation": [each.generation for each in rows],
        "mean": [_short(each.mean) for each in rows],
        "error": [_short(each.error) for each in rows],
        "episodes": [each.episodes for each in rows],
    }
    return told if spent is None else told | _spent([_at(spent, each.generation) for each in rows])


def _confirmed(found: StoredConfirmation, course: Course, spent: Sequence[Effort] | None) -> dict[str, Any]:
    told = {"generation": found.generation, "mean": _short(found.mean), "error": _short(found.error)}
    told["episodes"] = found.episodes
    if spent is None:
        return told
    columns = _spent([_at(spent, len(course.history) - 1)])
    return told | {name: column[0] for name, column in columns.items()}


def _at(spent: Sequence[Effort], generation: int) -> Effort:
    return spent[min(generation, len(spent) - 1)] if spent and generation >= 0 else Effort()


def _spent(efforts: Sequence[Effort]) -> dict[str, list[float]]:
    return {
        "steps": [each.steps for each in efforts],
        "core_hours": [float(f"{each.core_hours:.6g}") for each in efforts],
    }


def _short(value: float) -> float | None:
    """As much of a number as a chart shows; nothing of one that is none."""
    short = float(f"{value:.5g}")
    return short if math.isfinite(short) else None
