"""Who chooses the actions of a drive: a controller by a world model, or a random driver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.controller import Controller
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.worker.tasks.api import Collected, Policy, Sourced
from dreamfleet.worker.tasks.policy import ALL, Driven
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.inference import Controllers
from dreamfleet.worker.worldmodel.mind import Mind

Floats = NDArray[np.float32]


class Hand(Protocol):
    """Chooses; whoever drives by it tells its mind, if it has one, what is seen, done and rewarded."""

    @property
    def mind(self) -> Mind | None:
        """By which it chooses."""

    def choose(self, seen: Any, /) -> Floats:
        """The next action `(1, actions)`; `seen` is what the world shows, which its mind has been told."""


class ControllersHand:
    """A controller, by the mind of the world model that it was evolved in, under its shape and variant."""

    def __init__(self, controller: Controller, bundle: Bundle, mind: Mind) -> None:
        self._controllers = Controllers(bundle.fitting(controller))
        self._parameters = controller.parameters.reshape(1, -1)
        self.mind = mind

    def choose(self, _seen: Any) -> Floats:
        """What the controller does now."""
        return self._controllers.act(self._parameters, self.mind.latent, self.mind.state)


class DriversHand:
    """A driver without a mind, of one drive."""

    mind = None

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        policy.begin(np.zeros(0, dtype=np.float32))

    def choose(self, seen: Any) -> Floats:
        """The driver's next action."""
        action: Floats = self._policy.act(seen)[None]
        return action


def controllers_hand(controller: Controller, own: Bundle, bundle: Bundle, mind: Mind) -> Hand:
    """A controller of the world model `own` where `bundle` watches by `mind`; both must see the same pictures."""
    if own.sha256 == bundle.sha256:
        return ControllersHand(controller, bundle, mind)
    check_sees(own, bundle)
    return ControllersHand(controller, own, Mind(own.fitting(controller)))


def check_sees(own: Bundle, bundle: Bundle) -> None:
    """`ControllerError` unless a controller of the world model `own` sees what `bundle` does."""
    if (own.manifest.task, own.manifest.preprocessing) != (bundle.manifest.task, bundle.manifest.preprocessing):
        raise ControllerError(
            f"the controller sees {own.manifest.preprocessing} of {own.manifest.task}, {bundle.manifest.name} "
            f"{bundle.manifest.preprocessing} of {bundle.manifest.task}: choose one that sees the same"
        )


def drivers_hands(bundle: Bundle, name: str) -> Callable[[int], Hand]:
    """The hand of a seed: the random driver of that name of the bundle's world; `UsageError` lists those there are.

    The names are those that a data set is collected by.
    """
    task = find_task(bundle.manifest.task)
    drivers = list(task.drivers.items()) if isinstance(task, Collected) else []
    policies = task.policies if isinstance(task, Sourced) else {}
    known = (*((ALL,) if drivers else ()), *dict(drivers), *policies)
    if name not in known:
        raise UsageError(
            f"task {bundle.manifest.task} has no driver {name!r}: choose one of {', '.join(known) or 'none'}, or a "
            "--controller"
        )

    def hand(seed: int) -> Hand:
        random = np.random.default_rng(seed)
        if name in policies:
            return DriversHand(policies[name](random))
        make = drivers[seed % len(drivers)][1] if name == ALL else dict(drivers)[name]
        return DriversHand(Driven(make(random)))

    return hand
