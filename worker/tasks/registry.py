"""Tasks as a worker finds them, and what is wrong with one that is incomplete."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from dreamfleet.common.artifacts.actions import Continuous, Discrete
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.tasks import load_task, registered_tasks
from dreamfleet.worker.tasks.api import Task, World

REQUIRED_METHODS = ("make_environment", "make_judge", "make_policy", "world_of")


def known_tasks() -> tuple[str, ...]:
    """Names of the registered tasks and families."""
    return tuple(registered_tasks())


def find_task(name: str) -> Task:
    """A task by name; `UsageError` lists the registered ones, or says what this one lacks."""
    task = load_task(name)
    if missing := list(_find_problems(task)):
        raise UsageError(f"task {name!r} is incomplete: {'; '.join(missing)}; docs/tasks.md shows a whole one")
    found: Task = task
    return found


def _find_problems(task: Any) -> Iterator[str]:
    if not isinstance(getattr(task, "name", None), str):
        yield "name must be a text"
    width = getattr(task, "width", None)
    if not isinstance(width, int) or not 1 <= width <= 1024:
        yield f"width must be a whole number from 1 to 1024, not {width!r}"
    world = getattr(task, "world", None)
    if getattr(type(task), "world_of", Task.world_of) is not Task.world_of:
        pass  # it asks its bundle
    elif not isinstance(world, World):
        yield f"world must be a World, not {type(world).__name__}"
    elif not isinstance(world.actions, (Continuous, Discrete)):
        yield f"world.actions must be Continuous or Discrete, not {type(world.actions).__name__}"
    for maker in REQUIRED_METHODS:
        if not callable(getattr(task, maker, None)) or getattr(type(task), maker, None) is Task.make_environment:
            yield f"{maker}(assignment) is missing"
