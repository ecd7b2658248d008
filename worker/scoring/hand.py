"""Who chooses the actions of a drive: a controller by a world model, or a driver that does not look."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.controller import Controller
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.worker.tasks.api import Collected
from dreamfleet.worker.tasks.policy import Driver
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.inference import Controllers
from dreamfleet.worker.worldmodel.mind import Mind

Floats = NDArray[np.float32]


class Hand(Protocol):
    """Chooses; whoever drives by it tells its mind, if it has one, what is seen, done and rewarded."""

    @property
    def mind(self) -> Mind | None:
        """By which it chooses."""

    def choose(self) -> Floats:
        """The next action `(1, actions)`."""


class ControllersHand:
    """A controller, by the mind of the world model that it was evolved in, under its shape and variant."""

    def __init__(self, controller: Controller, bundle: Bundle, mind: Mind) -> None:
        self._controllers = Controllers(bundle.fitting(controller))
        self._parameters = controller.parameters.reshape(1, -1)
        self.mind = mind

    def choose(self) -> Floats:
        """What the controller does now."""
        return self._controllers.act(self._parameters, self.mind.latent, self.mind.state)


class DriversHand:
    """A driver that does not look."""

    mind = None

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    def choose(self) -> Floats:
        """The driver's next action."""
        return self._driver.act()[None]


def controllers_hand(controller: Controller, own: Bundle, bundle: Bundle, mind: Mind) -> Hand:
    """A controller of the world model `own` where `bundle` watches by `mind`; both must see the same pictures."""
    if own.sha256 == bundle.sha256:
        return ControllersHand(controller, bundle, mind)
    if (own.manifest.task, own.manifest.preprocessing) != (bundle.manifest.task, bundle.manifest.preprocessing):
        raise ControllerError(
            f"the controller sees {own.manifest.preprocessing} of {own.manifest.task}, {bundle.manifest.name} "
            f"{bundle.manifest.preprocessing} of {bundle.manifest.task}: choose one that sees the same"
        )
    return ControllersHand(controller, own, Mind(own.fitting(controller)))


def drivers_hands(bundle: Bundle, name: str) -> Callable[[int], Hand]:
    """The hand of a seed: the random driver of that name of the bundle's world; `UsageError` lists those there are."""
    task = find_task(bundle.manifest.task)
    drivers = task.drivers if isinstance(task, Collected) else {}
    if name not in drivers:
        known = ", ".join(drivers) or "none"
        raise UsageError(
            f"task {bundle.manifest.task} has no driver {name!r}: choose one of {known}, or a --controller"
        )
    return lambda seed: DriversHand(drivers[name](np.random.default_rng(seed)))
