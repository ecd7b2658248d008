"""Evolve World-Models controllers on whatever machines you have.

The few names that a program needs; docs/tutorials/notebook.ipynb shows most of them at work. Each is imported when it
is first used, so that a coordinator needs no simulator and a reader of journals no world model.

>>> import dreamfleet
>>> controller = dreamfleet.find_controller("tiny")
>>> controller.parameters.shape
(867,)
"""

from __future__ import annotations

import os

if os.path.isfile(os.path.join(os.path.dirname(__file__), "common")):  # noqa: PTH113, PTH118, PTH120
    raise ImportError(
        "dreamfleet/common is a file: git made no symbolic links. Make them: "
        "git config core.symlinks true && git checkout -- dreamfleet"
    )

TYPE_CHECKING = False  # `typing` takes milliseconds, in which Ctrl-C would still print a traceback
if TYPE_CHECKING:
    from typing import Any

    from dreamfleet.common.addons.batches.remote_scorer import RemoteBatch, RemoteScorer
    from dreamfleet.common.artifacts.actions import Continuous, Discrete
    from dreamfleet.common.artifacts.bundle import Bundle
    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.artifacts.controller import Controller, ControllerShape
    from dreamfleet.common.client.client import Client
    from dreamfleet.common.errors import DreamfleetError, UsageError
    from dreamfleet.common.protocol.messages import TaskSpec
    from dreamfleet.common.protocol.tasks import Description
    from dreamfleet.common.runs.episode_results import EpisodeResults
    from dreamfleet.coordinator.addons.runs.stored_run import StoredRun as Run
    from dreamfleet.coordinator.addons.runs.stored_run import open_run
    from dreamfleet.experiments.controllers import (
        evaluate,
        find_agent,
        find_controller,
        make_environment,
        make_policy,
    )
    from dreamfleet.experiments.minimise import maximise, minimise
    from dreamfleet.experiments.started_run import evolve, start_run
    from dreamfleet.worker.scoring.scorer import Scorer
    from dreamfleet.worker.tasks.api import Task, World

_HOMES = {
    "Bundle": "common.artifacts.bundle",
    "Client": "common.client.client",
    "Continuous": "common.artifacts.actions",
    "Controller": "common.artifacts.controller",
    "ControllerShape": "common.artifacts.controller",
    "Description": "common.protocol.tasks",
    "Discrete": "common.artifacts.actions",
    "DreamfleetError": "common.errors",
    "EpisodeResults": "common.runs.episode_results",
    "RemoteBatch": "common.addons.batches.remote_scorer",
    "RemoteScorer": "common.addons.batches.remote_scorer",
    "Run": "coordinator.addons.runs.stored_run:StoredRun",
    "Scorer": "worker.scoring.scorer",
    "Task": "worker.tasks.api",
    "TaskSpec": "common.protocol.messages",
    "UsageError": "common.errors",
    "World": "worker.tasks.api",
    "evaluate": "experiments.controllers",
    "evolve": "experiments.started_run",
    "find_agent": "experiments.controllers",
    "find_bundle": "common.artifacts.bundle_store",
    "find_controller": "experiments.controllers",
    "make_environment": "experiments.controllers",
    "make_policy": "experiments.controllers",
    "maximise": "experiments.minimise",
    "minimise": "experiments.minimise",
    "open_run": "coordinator.addons.runs.stored_run",
    "start_run": "experiments.started_run",
}
__all__ = [
    "Bundle",
    "Client",
    "Continuous",
    "Controller",
    "ControllerShape",
    "Description",
    "Discrete",
    "DreamfleetError",
    "EpisodeResults",
    "RemoteBatch",
    "RemoteScorer",
    "Run",
    "Scorer",
    "Task",
    "TaskSpec",
    "UsageError",
    "World",
    "evaluate",
    "evolve",
    "find_agent",
    "find_bundle",
    "find_controller",
    "make_environment",
    "make_policy",
    "maximise",
    "minimise",
    "open_run",
    "start_run",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        from dreamfleet.common.printable import suggest

        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{suggest(name, _HOMES, listed=False)}")
    from importlib import import_module

    module, _, original = _HOMES[name].partition(":")
    found = getattr(import_module(f"{__name__}.{module}"), original or name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
