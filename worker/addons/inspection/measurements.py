"""Measure a world model: choose who drives, drive in its world, and compare with its dreams."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.cli.progress import progress_bar
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.stop_signals import Stop, stopping
from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
from dreamfleet.worker.addons.inspection.disturbed_rollouts import (
    DisturbedDrive,
    DisturbedDriveConfig,
    record_disturbed_drives,
)
from dreamfleet.worker.addons.inspection.drivers import make_controller_actor, make_driver_actors
from dreamfleet.worker.addons.inspection.likeness import compare_frequencies
from dreamfleet.worker.addons.inspection.measure import (
    FIGURES,
    UNITS,
    FigureName,
    FigureReport,
    MeasureReport,
    MeasureRequest,
    OnFigure,
)
from dreamfleet.worker.addons.inspection.page_builder import InspectionSubject, find_subject
from dreamfleet.worker.addons.inspection.probe import cross_validate_probes
from dreamfleet.worker.addons.inspection.road_losses import (
    LossReport,
    RoadLossConfig,
    collect_losing_drives,
    compare_losses,
)
from dreamfleet.worker.addons.inspection.survival import SurvivalConfig, fixed_drivers, measure_survival
from dreamfleet.worker.dream.batch import DEFAULT_TEMPERATURE
from dreamfleet.worker.dream.world import world_of
from dreamfleet.worker.scoring.actors import Actor
from dreamfleet.worker.tasks.recordable import TaskWithBeginnings
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState


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


def choose_driver(
    subject: InspectionSubject, controller_name: str | None, runs_dir: Path
) -> tuple[Bundle, DriverChoice]:
    """The world model to look into, and the controller that drives: the named one, else the subject's own."""
    controller, own = subject.controller, subject.bundle
    if controller_name:
        controller, beside = find_controller(controller_name, runs_dir)
        if own is None or controller.bundle != own.sha256:
            own = find_bundle_of(controller, None, beside)
    bundle = subject.bundle or own
    if bundle is None:
        raise UsageError("give a bundle or a run to measure, or a --controller that has a world model")
    return bundle, DriverChoice(controller, own)


def measure_figures(request: MeasureRequest, stop: Stop, on_figure: OnFigure) -> MeasureReport:
    """As `measure`."""
    with find_subject(request.subject, request.runs_dir) as subject:
        if request.subject and subject.bundle is None:
            raise UsageError(f"run {request.subject} has no world model to measure: name a bundle, or a run with one")
        bundle, driving = choose_driver(subject, request.controller, request.runs_dir)
        if request.driver:
            driving = DriverChoice(driver=request.driver)
        elif driving.controller is None and request.figures != ("survival",):
            raise UsageError("name who drives: --controller, or for --probe a --driver")
        anywhere = bool(driving.driver) and isinstance(task_of(bundle), TaskWithBeginnings)
        config = DisturbedDriveConfig(
            request.noise, first_seed=request.seed, opening=world_of(bundle).opening, anywhere=anywhere
        )
        temperature = request.temperature
        if temperature is None:
            temperature = (subject.run.spec.temperature if subject.run else 0.0) or DEFAULT_TEMPERATURE
        found: dict[FigureName, FigureReport] = {}
        for name in FIGURES:
            if name in request.figures:
                found[name] = _measure_one(name, request, bundle, driving, config, temperature, stop)
                on_figure(name, found[name])
    driver = driving.driver or (driving.controller.sha256 if driving.controller else None)
    return MeasureReport(bundle.sha256, request.noise, request.seed, driver, found)


def _measure_one(
    name: FigureName, request: MeasureRequest, bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig,
    temperature: float, stop: Stop,
) -> FigureReport:  # fmt: skip
    default, unit = UNITS[name]
    total = count = default if request.episodes is None else request.episodes
    if name == "survival":
        policies = len(fixed_drivers(task_of(bundle), world_of(bundle))) + (driving.controller is not None)
        total = 2 * policies * count
    with progress_bar(name, total, unit) as bar:
        on_count = stopping(bar.update, stop)
        if name == "survival":
            lives = SurvivalConfig(count, request.seed, temperature, request.end)
            return measure_survival(bundle, driving.controller, lives, on_count)
        if name == "probe":
            return cross_validate_probes(_first_drives(bundle, driving, config, count, on_count), config.opening)
        losses = RoadLossConfig(count, temperature=temperature)
        if name == "losses":
            return measure_dream_losses(bundle, driving, config, losses, on_count)
        controller = _dream_controller(bundle, driving)
        drives = _first_drives(bundle, driving, config, count, on_count)
        return compare_frequencies(drives, bundle, controller, config.opening, losses.dreams, temperature)


def measure_dream_losses(
    bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig, losses: RoadLossConfig,
    on_loss: Callable[[int], None],
) -> LossReport:  # fmt: skip
    """Compare real losses of the road with dreams begun before them.

    `UsageError` unless the driver is a controller that was evolved with this world model, because it also drives the
    dreams.
    """
    controller = _dream_controller(bundle, driving)
    drives = collect_losing_drives(_drives(bundle, driving, config), losses, config, on_loss)
    return compare_losses(drives, bundle, controller, losses, config)


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
    bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig, episodes: int, on_drive: Callable[[int], None]
) -> list[DisturbedDrive]:
    drives = []
    for drive in islice(_drives(bundle, driving, config), episodes):
        drives.append(drive)
        on_drive(len(drives))
    return drives
