"""Who chooses the actions of a drive: a controller by a world model, or a random driver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.worker.tasks.api import Policy, RecordableTask, TaskWithPolicies
from dreamfleet.worker.tasks.policy import ALL_DRIVERS, DriverPolicy
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.inference import Controllers
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState

Floats = NDArray[np.float32]


class Actor(Protocol):
    """Chooses; whoever drives by it tells its mind, if it has one, what is seen, done and rewarded."""

    @property
    def mind(self) -> RecurrentState | None:
        """By which it chooses."""

    def choose(self, seen: Any, /) -> Floats:
        """The next action `(1, actions)`; `seen` is what the world shows, which its mind has been told."""


class ControllerActor:
    """A controller, by the mind of the world model that it was evolved in, under its shape and variant."""

    def __init__(self, controller: Controller, bundle: Bundle, mind: RecurrentState) -> None:
        self._controllers = Controllers(bundle.for_controller(controller))
        self._parameters = controller.parameters.reshape(1, -1)
        self.mind = mind

    def choose(self, _seen: Any) -> Floats:
        """What the controller does now."""
        return self._controllers.act(self._parameters, self.mind.latent, self.mind.state)


class DriverActor:
    """A driver without a mind, of one drive."""

    mind = None

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        policy.begin(np.zeros(0, dtype=np.float32))

    def choose(self, seen: Any) -> Floats:
        """The driver's next action."""
        action: Floats = self._policy.act(seen)[None]
        return action


def make_controller_actor(controller: Controller, own: Bundle, bundle: Bundle, mind: RecurrentState) -> Actor:
    """A controller of the world model `own` where `bundle` watches by `mind`; both must see the same pictures."""
    if own.sha256 == bundle.sha256:
        return ControllerActor(controller, bundle, mind)
    check_same_pictures(own, bundle)
    return ControllerActor(controller, own, RecurrentState(own.for_controller(controller)))


def check_same_pictures(own: Bundle, bundle: Bundle) -> None:
    """`ControllerError` unless a controller of the world model `own` sees what `bundle` does."""
    if (own.manifest.task, own.manifest.preprocessing) != (bundle.manifest.task, bundle.manifest.preprocessing):
        raise ControllerError(
            f"the controller sees {own.manifest.preprocessing} of {own.manifest.task}, {bundle.manifest.name} "
            f"{bundle.manifest.preprocessing} of {bundle.manifest.task}: choose one that sees the same"
        )


def make_driver_actors(bundle: Bundle, name: str) -> Callable[[int], Actor]:
    """The hand of a seed: the random driver of that name of the bundle's world; `UsageError` lists those there are.

    The names are those that a data set is collected by.
    """
    task = find_task(bundle.manifest.task)
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
