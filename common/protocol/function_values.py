"""What people read of a function's run: its own values, where fitness is the negated value of one that is minimised.

Journal, wire, JSON and tables for programs hold fitness; text, pictures and pages show values. Pages: tasks.md.
"""

from functools import lru_cache

from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import is_function_task


def is_minimised(task: TaskSpec) -> bool:
    """Whether the task is a function that is minimised, so that its values are the negated fitness."""
    return minimises(task.task, task.options)


def minimises(task: str, options: str) -> bool:
    """`is_minimised`, of a task's name and its options as a run freezes them."""
    return is_function_task(task) and _minimises(options)


@lru_cache(maxsize=64)
def _minimises(options: str) -> bool:
    try:
        return Objective.parse(options).minimise
    except UsageError:
        return False


def fitness_word(task: TaskSpec) -> str:
    """What people call a candidate's score: a function has a value, any other task a fitness."""
    return "value" if is_function_task(task.task) else "fitness"


def value_of(fitness: float, task: TaskSpec) -> float:
    """The function's value of a fitness; of any other task the fitness."""
    return 0.0 - fitness if is_minimised(task) else fitness  # of zero no negative one
