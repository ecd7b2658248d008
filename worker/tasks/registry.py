"""Finding tasks by name or world model: which ones this worker may look up, and what an incomplete one lacks.

Looking up a task's name imports a module and calls what the name refers to. A coordinator's message must not cause
that, so a worker announces the tasks that it has in its hello, and checks every other name before it looks it up.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from dreamfleet.common.artifacts.actions import Continuous, Discrete
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import BundleError, RefusedError, UsageError
from dreamfleet.common.protocol.tasks import family_of, load_task, registered_tasks
from dreamfleet.worker.tasks.api import Task, World
from dreamfleet.worker.tasks.recordable import Preprocessing, RecordableTask, TaskWithOptions

REQUIRED_METHODS = ("make_environment", "make_evaluation_environment", "make_policy", "world_of")


def check_task_allowed(task: str, allowed_tasks: Collection[str]) -> None:  # docs/how-to/trust.md
    """`RefusedError` unless this worker announced the task or its family."""
    if family_of(task) not in allowed_tasks:
        raise RefusedError(
            f"the run scores in task {task!r}, which this worker did not announce: install the package that "
            "registers it; or, if you trust it, start the worker with it", ("--task", task),
        )  # fmt: skip


def check_world_allowed(bundle: Bundle, allowed_tasks: Collection[str]) -> None:
    """`RefusedError` if a bundle's task is in a module that this worker did not announce."""
    if ":" in bundle.manifest.task:
        check_task_allowed(bundle.manifest.task, allowed_tasks)


def known_tasks() -> tuple[str, ...]:  # docs/reference/protocol.md
    """Names of the registered tasks and families."""
    return tuple(registered_tasks())


def find_task(name: str) -> Task:
    """A task by name; `UsageError` lists the registered ones, or says what this one lacks."""
    task = load_task(name)
    if missing := list(_find_problems(task)):
        raise UsageError(
            f"task {name!r} is incomplete: {'; '.join(missing)}; docs/reference/tasks.md shows a whole one"
        )
    found: Task = task
    return found


def find_world(name: str, options: str = "") -> RecordableTask:
    """A task by name, under `options` as its `parse_options` writes them; `UsageError` if it cannot be recorded."""
    task = _bind(find_task(name), options)
    if not isinstance(task, RecordableTask):
        raise UsageError(
            f"task {name!r} has no drivers and pictures to collect: docs/reference/worlds.md says what it needs"
        )
    return task


def task_of(bundle: Bundle) -> Task:
    """The task that a bundle was trained on, under the options in its manifest; errors as in `find_world`."""
    manifest = bundle.manifest
    return _bind(find_task(manifest.task), manifest.world.options)


def find_scored_task(name: str, bundle: Bundle | None) -> Task:
    """The task of a run's specification: that of its bundle under the bundle's options, or another one by name."""
    return task_of(bundle) if bundle is not None and bundle.manifest.task == name else find_task(name)


def preprocessing_for(bundle: Bundle, task: RecordableTask) -> Preprocessing:
    """The preprocessing of the bundle's pictures; `BundleError` if they are not of this task."""
    manifest, known = bundle.manifest, task.preprocessings
    found = known.get(manifest.preprocessing)
    if manifest.task != task.name or found is None or manifest.picture != found.shape:
        given = " or ".join(f"{each.name!r} {each.shape}" for each in known.values())
        raise BundleError(
            f"bundle {manifest.name} is of task {manifest.task!r} and pictures {manifest.preprocessing!r} "
            f"{manifest.picture}; {task.name} gives {given}"
        )
    return found


def _bind(task: Task, options: str) -> Task:
    if isinstance(task, TaskWithOptions):
        return task.with_options(options)
    if options:
        raise UsageError(f"task {task.name!r} has no options, and these are given: {options:.200}")
    return task


def _find_problems(task: Any) -> Iterator[str]:
    if not isinstance(getattr(task, "name", None), str):
        yield "name must be a text"
    batch_size = getattr(task, "batch_size", None)
    if not isinstance(batch_size, int) or not 1 <= batch_size <= 1024:
        yield f"batch_size must be a whole number from 1 to 1024, not {batch_size!r}"
    world = getattr(task, "world", None)
    if getattr(type(task), "world_of", Task.world_of) is not Task.world_of:
        pass  # its world follows from the bundle
    elif not isinstance(world, World):
        yield f"world must be a World, not {type(world).__name__}"
    elif not isinstance(world.actions, (Continuous, Discrete)):
        yield f"world.actions must be Continuous or Discrete, not {type(world.actions).__name__}"
    for maker in REQUIRED_METHODS:
        if not callable(getattr(task, maker, None)) or getattr(type(task), maker, None) is Task.make_environment:
            yield f"{maker}(assignment) is missing"
