"""The dream as a task: candidates are scored in it, many at once; what is reported is driven in reality."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium

from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.tasks.api import Assignment, Policy, Task, World
from dreamfleet.worker.tasks.registry import find_task

BATCH_SIZE = 256  # rows of a batch: larger ones are no faster


class DreamTask(Task):
    """The task `dream`, of any bundle that dreams: whatever is real is the bundle's own world's."""

    name = "dream"
    batch_size: ClassVar[int] = BATCH_SIZE

    def world_of(self, assignment: Assignment) -> World:
        """The bundle's own world."""
        return self.reality(assignment).world_of(assignment)

    def make_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any]:
        """Reality, as it is scored in: evaluations are driven, not dreamt."""
        return self.reality(assignment).make_environment(assignment)

    def make_evaluation_environment(
        self, assignment: Assignment, render_mode: str | None = None
    ) -> gymnasium.Env[Any, Any]:
        """Reality, as reported scores come from it."""
        return self.reality(assignment).make_evaluation_environment(assignment, render_mode)

    def make_policy(self, assignment: Assignment) -> Policy:
        """What drives in reality."""
        return self.reality(assignment).make_policy(assignment)

    def make_batch(self, assignment: Assignment) -> DreamBatch:
        """What scores candidates."""
        self.make_policy(assignment)  # refuses a bundle that does not fit its world
        return DreamBatch(assignment.world_model, assignment.spec, self.world_of(assignment))

    def reality(self, assignment: Assignment) -> Task:
        """The task of the world that the bundle was trained on; `UsageError` where no package registers it."""
        return find_task(assignment.world_model.manifest.task)
