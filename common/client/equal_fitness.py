"""Generations in a row whose candidates all have one fitness: a search that has nothing to go by. Pure."""

import math
from collections.abc import Iterable

from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import is_function_task
from dreamfleet.common.runs.records import StoredGeneration

ENOUGH = 5  # such generations in a row before a warning, and other ones before the next


class EqualFitness:
    """Follows closed generations: how many of the last ones in a row have candidates of one fitness."""

    def __init__(self, rows: Iterable[StoredGeneration] = ()) -> None:
        self.count = 0
        self.has_risen = False  # the last generation's worst candidate is better than the worst of all
        self.is_due = False  # the last generation is one to warn at
        self._worst, self._others, self._is_warned = math.inf, 0, False
        for row in rows:
            self.add(row)

    def add(self, row: StoredGeneration) -> None:
        """Add the generation that closed next."""
        is_equal = not row.failed and row.best == row.worst
        self.count, self._others = (self.count + 1, 0) if is_equal else (0, self._others + 1)
        self._worst = min(self._worst, row.worst)
        self.has_risen = row.worst > self._worst
        self.is_due = self.count >= ENOUGH and not self._is_warned
        self._is_warned = self.is_due or (self._is_warned and self._others < ENOUGH)

    def describe(self, task: TaskSpec) -> str:
        """As `describe_equal_fitness`, of the generations so far."""
        return describe_equal_fitness(self.count, task, has_risen=self.has_risen)


def describe_equal_fitness(generations: int, task: TaskSpec, *, has_risen: bool) -> str:
    """A warning with what helps, after `ENOUGH` such generations in a row; before, empty."""
    if generations < ENOUGH:
        return ""
    text = f"all candidates of the last {generations} generations have the same fitness, so nothing guides the search: "
    if has_risen:
        return text + "earlier ones had less, so this may be the best that there is"
    if is_function_task(task.task):
        return text + "let the function differ nearby, or choose a larger scale="
    return text + "give a reward on the way to the goal, a larger --sigma0 or a longer --horizon"
