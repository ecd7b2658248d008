"""The columns that the charts plot for a run, live or stored: generations and evaluations. Pure.

`page/charts.js` draws them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from dreamfleet.common.addons.analysis.run_archive import exploration_note
from dreamfleet.common.addons.analysis.scored_history import effort_axes, log_foot, spread_of, steps_text, value_axis
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.function_values import fitness_word, value_of
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import DREAM, is_function_task
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.records import (
    RunSettings,
    StoredConfirmation,
    StoredEvaluation,
    StoredGeneration,
    in_values,
)
from dreamfleet.common.runs.stages import begun_stages

MOST_POINTS = 600  # sent and drawn at most: a screen shows no more
T = TypeVar("T")
Quartiles = Mapping[int, tuple[float, float]]  # by generation


@dataclass(frozen=True)
class RunData:
    """A run's settings and results."""

    settings: RunSettings
    history: Sequence[StoredGeneration]
    evaluations: Sequence[StoredEvaluation]
    confirmed: StoredConfirmation | None
    episode_limit: int | None = None  # steps; of the environment itself


def downsample(rows: Sequence[T]) -> Sequence[T]:
    """Every k-th row and the last one, at most `MOST_POINTS`."""
    step = sampling_step(len(rows))
    kept = rows[::step]
    return [*kept, rows[-1]] if (len(rows) - 1) % step else kept


def sampling_step(rows: int) -> int:
    """The k of `downsample` for so many rows."""
    return max(math.ceil(rows / (MOST_POINTS - 1)), 1) if rows > MOST_POINTS else 1


def curves(
    data: RunData, quartiles: Quartiles | None, spent: Sequence[Effort] | None = None, word: str = "seed"
) -> dict[str, Any]:
    """The columns as a JSON document; `spent` is the effort up to each generation, including the run's start.

    Without quartiles the band is one standard deviation around the mean; `band` names which one it is. `word` names a
    seed of an evaluation.
    """
    settings, task = data.settings, data.settings.task
    rows = [in_values(each, task) for each in downsample(data.history)]
    dreamt, every = settings.task.task == DREAM, settings.evaluate_every
    often = "of each generation" if every == 1 else f"every {every} generations"
    stages = begun_stages(settings, data.history, data.evaluations)
    steps = steps_text(stages, task, data.episode_limit)
    band, looks = _band(rows, quartiles, task), downsample(data.evaluations)
    reported = [] if data.confirmed is None else [data.confirmed]
    confirmed = _judged(reported, [len(data.history) - 1] * len(reported), task, spent)
    begin = log_foot(rows, [in_values(each, task) for each in looks], task)
    is_log, foot = begin is not None, -math.inf if begin is None else begin
    axis = value_axis(task, is_log=is_log) if is_function_task(task.task) else ""
    drawn: dict[str, Any] = {
        "step": sampling_step(len(data.history)),
        "generation": [each.number for each in rows],
        "mean": [rounded(max(each.mean, foot)) for each in rows],
        "best": [rounded(max(each.best, foot)) for each in rows],
        "low": [rounded(max(low, foot)) for low, _ in band],
        "high": [rounded(high) for _, high in band],
        "band": "± 1 standard deviation" if quartiles is None else "the middle half of the candidates",
        "sigma": [rounded(each.sigma) for each in rows],
        "evaluations": _judged(looks, [each.generation for each in looks], task, spent),
        "confirmed": {name: column[0] for name, column in confirmed.items()} if reported else None,
        "stages": [each.since for each in stages[1:]],
        "dreamt": dreamt,
        "fitness_axis": axis or f"fitness over {steps}",
        "score_word": fitness_word(task),
        "log": is_log,
        "score_axis": axis or f"score{' in reality' * dreamt}, mean of {plural(settings.evaluation_episodes, word)}",
        "coming": "Once the first generation closes: the mean, the best and the spread of its candidates"
        f"{f', and the evaluated mean {often}' if every else ''}.",
        "note": exploration_note(settings),
    }
    if spent is not None:
        drawn |= _effort_columns([spent[each.number] for each in rows if each.number < len(spent)])
        drawn["spent_axes"] = effort_axes(calls=is_function_task(task.task))
    return drawn


def _band(rows: Sequence[StoredGeneration], quartiles: Quartiles | None, task: TaskSpec) -> list[tuple[float, float]]:
    """The band's ends of rows in values; quartiles are of fitness."""
    if quartiles is None:
        return [spread_of(each) for each in rows]
    fitness = [quartiles.get(each.number) for each in rows]
    return [(each.mean, each.mean) if pair is None else tuple(sorted(value_of(end, task) for end in pair))  # type: ignore[misc]
            for each, pair in zip(rows, fitness, strict=True)]  # fmt: skip


def _judged(
    rows: Sequence[StoredEvaluation] | Sequence[StoredConfirmation], until: Sequence[int], task: TaskSpec,
    spent: Sequence[Effort] | None,
) -> dict[str, list[Any]]:  # fmt: skip
    """Columns of means that were judged, with the effort until the end of these generations."""
    columns: dict[str, list[Any]] = {
        "generation": [each.generation for each in rows],
        "mean": [rounded(value_of(each.mean, task)) for each in rows],
        "error": [rounded(each.error) for each in rows],
        "episodes": [each.episodes for each in rows],
    }
    if spent is None:
        return columns
    efforts = [spent[min(each, len(spent) - 1)] if spent and each >= 0 else Effort() for each in until]
    return columns | _effort_columns(efforts)


def _effort_columns(efforts: Sequence[Effort]) -> dict[str, list[float]]:
    return {
        "steps": [each.steps for each in efforts],
        "core_hours": [float(f"{each.core_hours:.6g}") for each in efforts],
    }


def rounded(value: float | None) -> float | None:
    """The number with the 5 digits that a page shows at most; `None` for NaN and infinity, and for no number."""
    short = math.nan if value is None else float(f"{value:z.5g}")
    return short if math.isfinite(short) else None
