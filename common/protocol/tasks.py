"""Tasks by name, as both sides find them: which are registered, and what a new run must know of one.

A name is one that a package registers under the entry-point group `dreamfleet.tasks`; a family's name with what makes
one of it (`gym:LunarLander-v3`); or `module:attribute`, for a task that no package registers.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.host.packages import install_command_for

GROUP = "dreamfleet.tasks"
_NAME = re.compile(r"[\w-][\w.-]*(:\S+)?", re.ASCII)
GYM = "gym"  # the family of gymnasium's environments: they need no bundle
DREAM = "dream"  # whose candidates take no step in reality


@dataclass(frozen=True)
class Description:
    """What a run freezes of a task that needs no bundle.

    >>> from dreamfleet import Description
    >>> Description(observations=4, outputs=2, packages=("numpy", "gymnasium")).version
    1
    """

    observations: int  # inputs of a controller
    outputs: int  # of a controller
    packages: tuple[str, ...] = NUMERIC_PACKAGES  # whose versions a fitness may depend on
    version: int = 1
    options: str = ""  # canonical JSON


def registered_tasks() -> dict[str, EntryPoint]:
    """The registered tasks and families by name."""
    return {point.name: point for point in sorted(entry_points(group=GROUP), key=lambda point: point.name)}


def family_of(name: str) -> str:
    """What a worker announces to know a task: the registered name or family, or the whole of `module:attribute`."""
    head, colon, _ = name.partition(":")
    return head if colon and head in registered_tasks() else name


def is_unregistered(name: str) -> bool:
    """Whether it is `module:attribute`, which a worker must be told of: nothing that is registered here."""
    return ":" in name and family_of(name) == name


def load_task(name: str) -> Any:
    """The object that stands for a task; `UsageError` says what is known, or why it cannot be loaded."""
    points = registered_tasks()
    head, colon, rest = name.partition(":")
    try:
        if head in points:
            make = points[head].load()
            return make(rest) if colon else make()
        if colon:
            return _task_class(import_module(head), rest)()
    except ModuleNotFoundError as error:
        remedy = install_command_for(error.name) or (
            "install the package that has it, or name its folder in PYTHONPATH: the current folder is not searched"
        )
        raise UsageError(f"task {name!r} cannot be loaded: no module {error.name!r} here; {remedy}") from error
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise UsageError(f"task {name!r} cannot be loaded: {error}") from error
    known = ", ".join(f"{each}:ENVIRONMENT" if each == GYM else each for each in points) or "none"
    raise UsageError(f"unknown task {name!r}: known are {known}")


def _task_class(module: Any, name: str) -> Any:
    """A task's class in a module; nothing else is called, for the name may come from a file that was passed on."""
    found = getattr(module, name)
    if not isinstance(found, type):
        raise TypeError(f"{name} of {module.__name__} is no task: it is no class")
    return found


def is_self_describing(name: str) -> bool:
    """Whether a task needs no bundle; `UsageError` for one that this host does not know."""
    if family_of(name) == GYM:
        return True
    point = registered_tasks().get(name)
    if point is not None and point.dist is not None and point.dist.name == "dreamfleet":
        return False  # not worth loading a simulator for
    try:
        return callable(getattr(load_task(name), "describe", None))
    except UsageError as error:
        raise UsageError(f"{error}; where workers alone have it, name its world model with --bundle") from error


def check_task(name: str) -> None:
    """`UsageError` for what cannot name a task, or nearly names a registered one."""
    if not _NAME.fullmatch(name):
        raise UsageError(f"{name!r} cannot name a task: give a registered name, {GYM}:ENVIRONMENT, or module:attribute")
    points = registered_tasks()
    head, colon, _ = name.partition(":")
    if head in points or "." in head:
        return
    near = difflib.get_close_matches(head, points, n=1, cutoff=0.75)
    if near:
        raise UsageError(f"unknown task {name!r}: did you mean {near[0]}{':...' if colon else ''}?")


def describe_task(name: str, options: Mapping[str, Any]) -> Description:
    """What a new run must know of a task that needs no bundle; `UsageError` if it does not say.

    The task's package must be installed where the run is begun, and only there and on workers.
    """
    task = load_task(name)
    if not callable(getattr(task, "describe", None)):
        raise UsageError(f"task {name!r} needs a world model: give one with --bundle")
    description: Description = task.describe(options)
    return description
