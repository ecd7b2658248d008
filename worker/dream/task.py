"""The dream as a task: candidates are scored in it, many at once; reported scores come from reality. Pages: gpu.md."""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.add_ons import add_on
from dreamfleet.worker.dream.batch import MAX_ROWS, TORCH_ROWS, DreamBatch
from dreamfleet.worker.tasks.api import Assignment, Policy, Task, World
from dreamfleet.worker.tasks.registry import task_of


class DreamTask(Task):
    """The task `dream` for any bundle that can dream. Everything real comes from the task of the bundle's world."""

    name = "dream"
    batch_size: ClassVar[int] = MAX_ROWS
    torch_batch_size: ClassVar[int] = TORCH_ROWS

    def world_of(self, assignment: Assignment) -> World:
        """The world of the bundle's task."""
        return self.reality(assignment).world_of(assignment)

    def make_environment(self, assignment: Assignment) -> gymnasium.Env[Any, Any]:
        """The real environment: evaluations are driven, not dreamt."""
        return self.reality(assignment).make_environment(assignment)

    def make_evaluation_environment(
        self, assignment: Assignment, render_mode: str | None = None
    ) -> gymnasium.Env[Any, Any]:
        """The real environment that reported scores come from."""
        return self.reality(assignment).make_evaluation_environment(assignment, render_mode)

    def make_policy(self, assignment: Assignment) -> Policy:
        """The policy that drives in reality."""
        return self.reality(assignment).make_policy(assignment)

    def make_batch(self, assignment: Assignment) -> DreamBatch:
        """The batch that dreams; `UsageError` for a torch device that this host lacks."""
        self.make_policy(assignment)  # raises `BundleError` if the bundle does not fit its world
        model, spec = assignment.world_model, assignment.spec
        if not assignment.torch_device:
            return DreamBatch(model, spec)
        try:
            batch: DreamBatch = add_on("torch-dreams")(model, spec, assignment.torch_device)
        except ModuleNotFoundError as error:
            raise UsageError(f"torch_device needs {error.name}: pip install 'dreamfleet[train]'") from error
        return batch

    def reality(self, assignment: Assignment) -> Task:
        """The task that the bundle was trained on; `UsageError` if no package registers it."""
        return task_of(assignment.world_model)
