"""What a worker lets a run ask of it: the tasks that it announced in its hello, and no other.

A task's name is code: to look a name up imports a module and calls what it names there. A coordinator's word is no
reason to do that, so a name is looked at here before anything is imported, in the worker and again in each child.
"""

from __future__ import annotations

from collections.abc import Collection

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import RefusedError
from dreamfleet.common.protocol.tasks import family_of


def check_task_allowed(task: str, allowed_tasks: Collection[str]) -> None:
    """`RefusedError` unless a task, or its family, is one that this worker announced."""
    if family_of(task) not in allowed_tasks:
        raise RefusedError(
            f"the run scores in task {task!r}, which this worker did not announce: start it with --task {task} if you "
            "trust that, or install the package that registers it"
        )


def check_world_allowed(bundle: Bundle, allowed_tasks: Collection[str]) -> None:
    """`RefusedError` if a world model names a module as its world, and this worker did not announce that."""
    if ":" in bundle.manifest.task:
        check_task_allowed(bundle.manifest.task, allowed_tasks)
