"""A run's closed generations as they are drawn and exported, and what all their pictures decide alike.

Pages: own-objective.md, dashboard.md.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from dreamfleet.common.protocol.function_values import is_minimised
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import BegunStage, describe_steps, join_distinct

TWO_DECADES = 100  # docs/tutorials/own-objective.md says when an axis is logarithmic


def scored_history(run: RunFolder, since: int = 0) -> list[StoredGeneration]:
    """As `RunFolder.history`, with NaN for the fitness of generations in which no candidate has one."""
    nan, unscored = math.nan, run.unscored_generations()
    return [
        replace(each, mean=nan, std=nan, best=nan, worst=nan) if each.number in unscored else each
        for each in run.history(since)
    ]


def log_foot(
    history: Iterable[StoredGeneration], evaluations: Iterable[StoredEvaluation], task: TaskSpec
) -> float | None:
    """Where a logarithmic axis of these rows begins, on which 0 is drawn; `None`: the axis is better linear.

    The rows are in a function's values (`in_values`). What counts are the best, the averages and the evaluated means.
    """
    values = [value for each in history for value in (each.best, each.mean)] + [each.mean for each in evaluations]
    return least_positive(values) if is_minimised(task) and spans_decades(values) else None


def spans_decades(values: Sequence[float]) -> bool:
    """Whether an axis of these values is better logarithmic: none is negative, and others than 0 span over two decades.

    >>> spans_decades([0.001, 1.0]), spans_decades([0.5, 1.0]), spans_decades([0.0, 0.001, 1.0])
    (True, False, True)
    """
    known = [each for each in values if not math.isnan(each)]
    return bool(known) and min(known) >= 0 and max(known) > TWO_DECADES * least_positive(known)


def least_positive(values: Iterable[float]) -> float:
    """The foot of a logarithmic axis, on which 0 is drawn; infinity if no value is above 0."""
    return min((each for each in values if each > 0), default=math.inf)


def spread_of(row: StoredGeneration) -> tuple[float, float]:
    """One standard deviation around a generation's average, cut at the worst and the best candidate."""
    low, high = sorted((row.best, row.worst))
    return max(row.mean - row.std, low), min(row.mean + row.std, high)


def steps_text(stages: Sequence[BegunStage], task: TaskSpec, limit: int | None) -> str:
    """The steps of a candidate's episodes in each stage; `limit` is the environment's own."""
    own = (each.stage.settings for each in stages)
    return join_distinct(
        describe_steps(each.task.horizon, each.driven, dreamt=task.task == DREAM, limit=limit) for each in own
    )


def goal_of(*, minimised: bool) -> str:
    """Which of a function's values are better."""
    return "smaller is better" if minimised else "larger is better"


def value_axis(task: TaskSpec, *, is_log: bool) -> str:
    """The name of an axis of a function's values."""
    return f"value of the function ({goal_of(minimised=is_minimised(task))}{', log scale' if is_log else ''})"


def effort_axes(*, calls: bool) -> dict[str, str]:
    """The names of axes of what a search spent: environment steps, or `calls` of a function, and core-hours."""
    spent = f"{'calls of the function' if calls else 'environment steps in reality'}, evaluations included"
    return {"steps": spent, "core_hours": "core-hours: time that slots worked on accepted results"}
