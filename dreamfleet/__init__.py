"""Evolve World-Models controllers on whatever machines you have.

What a program of one's own needs, few names: docs/notebook.ipynb shows most of them at work. Everything is imported
when it is first asked for, so that a coordinator needs no simulator and a reader of journals no world model.

>>> import dreamfleet
>>> controller = dreamfleet.find_controller("tiny")
>>> controller.parameters.shape
(867,)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dreamfleet.common.actions import Continuous, Discrete
    from dreamfleet.common.bundle import Bundle
    from dreamfleet.common.client import Client
    from dreamfleet.common.controller import Controller
    from dreamfleet.common.errors import DreamfleetError
    from dreamfleet.common.evaluated import Evaluated
    from dreamfleet.common.messages import TaskSpec
    from dreamfleet.common.runs import RunFolder as Run
    from dreamfleet.common.store import find_bundle
    from dreamfleet.common.tasks import Description
    from dreamfleet.worker.scoring.scorer import Scorer
    from dreamfleet.worker.tasks.api import Task, World
    from dreamfleet.worker.tools.face import (
        evaluate,
        find_agent,
        find_controller,
        make_environment,
        make_policy,
        open_run,
    )

_HOMES = {
    "Bundle": "common.bundle",
    "Client": "common.client",
    "Continuous": "common.actions",
    "Controller": "common.controller",
    "Description": "common.tasks",
    "Discrete": "common.actions",
    "DreamfleetError": "common.errors",
    "Evaluated": "common.evaluated",
    "Run": "common.runs:RunFolder",
    "Scorer": "worker.scoring.scorer",
    "Task": "worker.tasks.api",
    "TaskSpec": "common.messages",
    "World": "worker.tasks.api",
    "evaluate": "worker.tools.face",
    "find_agent": "worker.tools.face",
    "find_bundle": "common.bundle",
    "find_controller": "worker.tools.face",
    "make_environment": "worker.tools.face",
    "make_policy": "worker.tools.face",
    "open_run": "worker.tools.face",
}
__all__ = [
    "Bundle",
    "Client",
    "Continuous",
    "Controller",
    "Description",
    "Discrete",
    "DreamfleetError",
    "Evaluated",
    "Run",
    "Scorer",
    "Task",
    "TaskSpec",
    "World",
    "evaluate",
    "find_agent",
    "find_bundle",
    "find_controller",
    "make_environment",
    "make_policy",
    "open_run",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, original = _HOMES[name].partition(":")
    found = getattr(import_module(f"{__name__}.{module}"), original or name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
