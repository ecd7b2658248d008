"""Measure a world model on disturbed drives of its world."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.inspection.disturbed_rollouts import (
    DisturbedDrive,
    DisturbedDriveConfig,
    record_disturbed_drives,
)
from dreamfleet.worker.addons.inspection.knowledge import Knowledge, cross_validate_probes
from dreamfleet.worker.addons.inspection.likeness import LikenessReport, compare_frequencies
from dreamfleet.worker.addons.inspection.road_losses import (
    LossReport,
    RoadLossConfig,
    collect_losing_drives,
    compare_losses,
)
from dreamfleet.worker.scoring.actors import Actor, make_controller_actor, make_driver_actors
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState

OnCount = Callable[[int], None]


@dataclass(frozen=True)
class DriverChoice:
    """The driver: a controller with its own world model, or a random driver of the world by name."""

    controller: Controller | None = None
    own: Bundle | None = None
    driver: str = ""

    def observing_model(self, bundle: Bundle) -> Bundle:
        """The world model that observes the drives, set up for the controller if that was evolved with it."""
        if self.controller is None or self.controller.bundle != bundle.sha256:
            return bundle
        return bundle.for_controller(self.controller)

    def actors(self, bundle: Bundle, recurrent: RecurrentState) -> Callable[[int], Actor]:
        """Return a function from a drive's seed to its actor."""
        if self.controller is None:
            return make_driver_actors(bundle, self.driver)
        if self.own is None:
            raise UsageError("this controller sees no world model: give one that was evolved with one")
        actor = make_controller_actor(self.controller, self.own, bundle, recurrent)
        return lambda _seed: actor


def probe(
    bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig, episodes: int, on_drive: OnCount
) -> Knowledge:
    """Measure how much of the true state the world model holds, on `episodes` drives."""
    drives = _first_drives(bundle, driving, config, episodes, on_drive)
    return cross_validate_probes(drives, config.opening)


def likeness(
    bundle: Bundle,
    driving: DriverChoice,
    config: DisturbedDriveConfig,
    dreams: RoadLossConfig,
    episodes: int,
    on_drive: OnCount,
) -> LikenessReport:
    """Measure how often rare values occur in dreams, on `episodes` drives; errors as in `measure_dream_losses`."""
    controller = _dream_controller(bundle, driving)
    drives = _first_drives(bundle, driving, config, episodes, on_drive)
    found = compare_frequencies(drives, bundle, controller, config.opening, dreams.dreams, dreams.temperature)
    return LikenessReport(episodes, dreams.dreams, dreams.temperature, tuple(found))


def measure_dream_losses(
    bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig, losses: RoadLossConfig, on_loss: OnCount
) -> LossReport:
    """Compare real losses of the road with dreams begun before them.

    `UsageError` unless the driver is a controller that was evolved with this world model, because it also drives the
    dreams.
    """
    controller = _dream_controller(bundle, driving)
    drives = collect_losing_drives(_drives(bundle, driving, config), losses, config, on_loss)
    found = compare_losses(drives, bundle, controller, losses, config)
    return LossReport(len(drives), losses.dreams, losses.temperature, config.lasting, tuple(found))


def _dream_controller(bundle: Bundle, driving: DriverChoice) -> Controller:
    """The controller, which drives the dreams too."""
    controller = driving.controller
    if controller is None or controller.bundle != bundle.sha256:
        raise UsageError(
            "these dreams need a --controller that was evolved with this world model: it drives them; "
            "`dreamfleet lab refit CONTROLLER --to BUNDLE --data FOLDER` fits another one to it"
        )
    return controller


def _drives(bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig) -> Iterator[DisturbedDrive]:
    recurrent = RecurrentState(driving.observing_model(bundle))
    return record_disturbed_drives(bundle, recurrent, driving.actors(bundle, recurrent), config)


def _first_drives(
    bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig, episodes: int, on_drive: OnCount
) -> list[DisturbedDrive]:
    drives = []
    for drive in islice(_drives(bundle, driving, config), episodes):
        drives.append(drive)
        on_drive(len(drives))
    return drives
