"""Generations in a row whose candidates all have one fitness: a search that has nothing to go by. Pure."""

from __future__ import annotations

from collections.abc import Sequence

from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import is_function_task
from dreamfleet.common.runs.records import RunSettings, StoredGeneration

ENOUGH = 5  # such generations in a row before a warning


def has_equal_fitness(row: StoredGeneration) -> bool:
    """Whether no candidate of a closed generation failed, and all have one fitness."""
    return not row.failed and row.best == row.worst


def count_equal_fitness(rows: Sequence[StoredGeneration], settings: RunSettings) -> int:
    """How many of the last generations in a row have candidates of one fitness; 0 for submitted candidates."""
    if settings.is_external:
        return 0
    return next((number for number, row in enumerate(reversed(rows)) if not has_equal_fitness(row)), len(rows))


def describe_equal_fitness(generations: int, task: TaskSpec) -> str:
    """A warning with what helps, after `ENOUGH` such generations in a row; before, empty."""
    if generations < ENOUGH:
        return ""
    helps = (
        "let the function differ nearby, or choose a larger scale="
        if is_function_task(task.task)
        else "give a reward on the way to the goal, a larger --sigma0 or a longer --horizon"
    )
    return (
        f"all candidates of the last {generations} generations have the same fitness, so nothing guides the search: "
        f"{helps}"
    )
