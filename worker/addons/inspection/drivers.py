"""Who drives while a world model is measured: a random driver, or a controller of another world model."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.worker.scoring.actors import Actor, ControllerActor, Floats
from dreamfleet.worker.tasks.api import Policy
from dreamfleet.worker.tasks.policy import ALL_DRIVERS, NO_PARAMETERS, DriverPolicy
from dreamfleet.worker.tasks.recordable import RecordableTask, TaskWithPolicies
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState


class DriverActor:
    """A policy without a recurrent state, for one drive."""

    recurrent_state = None

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        policy.begin(NO_PARAMETERS)

    def choose(self, seen: Any) -> Floats:
        """The policy's next action `(1, actions)`."""
        action: Floats = self._policy.act(seen)[None]
        return action


def make_controller_actor(controller: Controller, own: Bundle, bundle: Bundle, watching: RecurrentState) -> Actor:
    """A controller of the world model `own`, while the world model `bundle` observes the drive by its state `watching`.

    The actor shares `watching` if both are the same world model. `ControllerError` unless both see the same pictures.
    """
    if own.sha256 == bundle.sha256:
        return ControllerActor(controller, bundle, watching)
    check_same_pictures(own, bundle)
    return ControllerActor(controller, own, RecurrentState(own.for_controller(controller)))


def check_same_pictures(own: Bundle, bundle: Bundle) -> None:
    """`ControllerError` unless the world models `own` and `bundle` see the same pictures of the same task."""
    if _pictures_of(own) != _pictures_of(bundle):
        raise ControllerError(
            f"the controller sees {own.manifest.preprocessing} of {own.manifest.task}, {bundle.manifest.name} "
            f"{bundle.manifest.preprocessing} of {bundle.manifest.task}: choose one that sees the same"
        )


def _pictures_of(bundle: Bundle) -> tuple[str, str, str]:
    manifest = bundle.manifest
    return manifest.task, manifest.facts.options, manifest.preprocessing


def make_driver_actors(bundle: Bundle, name: str) -> Callable[[int], Actor]:
    """A function from a seed to an actor: the random driver or policy `name` of the bundle's task.

    The names are those of `dreamfleet collect --driver`; `UsageError` lists them for an unknown one.
    """
    task = task_of(bundle)
    drivers = list(task.drivers.items()) if isinstance(task, RecordableTask) else []
    policies = task.policies if isinstance(task, TaskWithPolicies) else {}
    known = (*((ALL_DRIVERS,) if drivers else ()), *dict(drivers), *policies)
    if name not in known:
        raise UsageError(
            f"task {bundle.manifest.task} has no driver {name!r}: choose one of {', '.join(known) or 'none'}, or a "
            "--controller"
        )

    def actor(seed: int) -> Actor:
        random = np.random.default_rng(seed)
        if name in policies:
            return DriverActor(policies[name](random))
        make = drivers[seed % len(drivers)][1] if name == ALL_DRIVERS else dict(drivers)[name]
        return DriverActor(DriverPolicy(make(random)))

    return actor
