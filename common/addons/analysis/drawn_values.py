"""What every picture of a run decides alike: the kind of axis, the spread, and what its axes are called. Pure.

Pages: own-objective.md, dashboard.md.
"""

from collections.abc import Iterable, Sequence

from dreamfleet.common.protocol.function_values import is_minimised, least_positive, spans_decades
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.stages import BegunStage, describe_steps, join_distinct


def log_foot(
    history: Iterable[StoredGeneration], evaluations: Iterable[StoredEvaluation], task: TaskSpec
) -> float | None:
    """Where a logarithmic axis of these rows begins, on which 0 is drawn; `None`: the axis is better linear.

    The rows are in a function's values (`in_values`). What counts are the best, the averages and the evaluated means.
    """
    values = [value for each in history for value in (each.best, each.mean)] + [each.mean for each in evaluations]
    return least_positive(values) if is_minimised(task) and spans_decades(values) else None


def spread_of(row: StoredGeneration) -> tuple[float, float]:
    """One standard deviation around a generation's average, cut at the worst and the best candidate."""
    low, high = sorted((row.best, row.worst))
    return max(row.mean - row.std, low), min(row.mean + row.std, high)


def describe_all_steps(stages: Sequence[BegunStage], task: TaskSpec, limit: int | None) -> str:
    """The steps of a candidate's episodes in each stage; `limit` is the environment's own."""
    own = (each.stage.settings for each in stages)
    return join_distinct(
        describe_steps(each.task.horizon, each.driven, dreamt=task.task == DREAM, limit=limit) for each in own
    )


def goal_of(*, minimised: bool) -> str:
    """Which of a function's values are better."""
    return "smaller is better" if minimised else "larger is better"


def effort_axes(*, calls: bool) -> dict[str, str]:
    """The names of axes of what a search spent: environment steps, or `calls` of a function, and core-hours."""
    calls_or_steps = (
        "calls of the function, those of evaluated means included"
        if calls
        else "environment steps in reality, evaluations included"
    )
    return {"steps": calls_or_steps, "core_hours": "core-hours: time that slots worked on accepted results"}
