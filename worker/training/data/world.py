"""The world that a data set is of, as training asks for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.tasks.api import Policy, Preprocessing, RecordableTask, TaskWithPolicies
from dreamfleet.worker.tasks.registry import find_task

WORLD = "car-racing"  # of data sets that do not say another


def find_world(name: str = WORLD) -> RecordableTask:
    """The task of that name; `UsageError` if nothing can be collected in it."""
    task = find_task(name)
    if not isinstance(task, RecordableTask):
        raise UsageError(f"task {name!r} has no drivers and pictures to collect: docs/tasks.md tells what it takes")
    return task


def preprocessing_of_size(size: int, world: str = WORLD) -> Preprocessing:
    """The world's preprocessing whose pictures are so many pixels wide; `UsageError` if there is none."""
    known = find_world(world).preprocessings.values()
    for each in known:
        if each.size == size:
            return each
    raise UsageError(f"pictures are {' or '.join(str(each.size) for each in known)} pixels wide, not {size}")


def source_policies(world: str = WORLD) -> Mapping[str, Callable[[np.random.Generator], Policy]]:
    """The random policies that drive as those of a source do, by name; a world may have none."""
    task = find_world(world)
    return task.policies if isinstance(task, TaskWithPolicies) else {}


def known_drivers(world: str = WORLD) -> tuple[str, ...]:
    """Who may drive at random, by name."""
    return (*find_world(world).drivers, *source_policies(world))
