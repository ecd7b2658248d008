"""Figures of a world model, measured on disturbed drives of its world."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.controller import Controller
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.inspection.knowledge import Knowledge, measure
from dreamfleet.worker.inspection.likeness import Alike
from dreamfleet.worker.inspection.likeness import compare as alike
from dreamfleet.worker.inspection.losses import Compared, LossConfig, compare, gather
from dreamfleet.worker.inspection.witness import WitnessConfig, WitnessedDrive, witness
from dreamfleet.worker.scoring.hand import Hand, controllers_hand, drivers_hands
from dreamfleet.worker.worldmodel.mind import Mind

Told = Callable[[int], None]


@dataclass(frozen=True)
class Driving:
    """Who drives: a controller and its own world model, or a random driver of the world by name."""

    controller: Controller | None = None
    own: Bundle | None = None
    driver: str = ""

    def watching(self, bundle: Bundle) -> Bundle:
        """The world model that watches, under the controller if that drives by it."""
        if self.controller is None or self.controller.bundle != bundle.sha256:
            return bundle
        return bundle.fitting(self.controller)

    def hands(self, bundle: Bundle, mind: Mind) -> Callable[[int], Hand]:
        """The hand of each seed."""
        if self.controller is None:
            return drivers_hands(bundle, self.driver)
        if self.own is None:
            raise UsageError("this controller sees no world model: give one that was evolved with one")
        hand = controllers_hand(self.controller, self.own, bundle, mind)
        return lambda _seed: hand


def probe(bundle: Bundle, driving: Driving, config: WitnessConfig, episodes: int, on_drive: Told) -> Knowledge:
    """What the world model holds of the truth on so many drives."""
    drives = []
    for drive in islice(_drives(bundle, driving, config), episodes):
        drives.append(drive)
        on_drive(len(drives))
    return measure(drives, config.opening)


def likeness(
    bundle: Bundle, driving: Driving, config: WitnessConfig, dreams: LossConfig, episodes: int, on_drive: Told
) -> list[Alike]:
    """How often dreams come to what is rare on so many drives; `UsageError` as of `dream_losses`."""
    controller = _dreamer(bundle, driving)
    drives = []
    for drive in islice(_drives(bundle, driving, config), episodes):
        drives.append(drive)
        on_drive(len(drives))
    return alike(drives, bundle, controller, config.opening, dreams.dreams, dreams.temperature)


def dream_losses(
    bundle: Bundle, driving: Driving, config: WitnessConfig, losses: LossConfig, on_loss: Told
) -> tuple[list[Compared], int]:
    """Dreams begun before real losses of the road, and how many drives it took to find these.

    `UsageError` unless a controller drives that was evolved with this world model: it has to drive on in the dream.
    """
    controller = _dreamer(bundle, driving)
    drives = gather(_drives(bundle, driving, config), losses, config, on_loss)
    return compare(drives, bundle, controller, losses, config), len(drives)


def _dreamer(bundle: Bundle, driving: Driving) -> Controller:
    """Who drives in dreams too."""
    controller = driving.controller
    if controller is None or controller.bundle != bundle.sha256:
        raise UsageError(
            "these dreams need a --controller that was evolved with this world model: it drives them; "
            "`dreamfleet refit CONTROLLER --to BUNDLE --data FOLDER` fits another one to it"
        )
    return controller


def _drives(bundle: Bundle, driving: Driving, config: WitnessConfig) -> Iterator[WitnessedDrive]:
    mind = Mind(driving.watching(bundle))
    return witness(bundle, mind, driving.hands(bundle, mind), config)
