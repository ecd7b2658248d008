"""Measure a world model: choose who drives, drive in its world, and compare with its dreams."""

from collections.abc import Callable, Iterator
from itertools import islice

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.cli.progress import progress_bar
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.stop_signals import Stop, stopping
from dreamfleet.worker.addons.inspection import measure
from dreamfleet.worker.addons.inspection.disturbed_rollouts import (
    DisturbedDrive,
    DisturbedDriveConfig,
    record_disturbed_drives,
)
from dreamfleet.worker.addons.inspection.dream_comparisons import (
    RoadLossConfig,
    collect_losing_drives,
    compare_frequencies,
    compare_losses,
)
from dreamfleet.worker.addons.inspection.probe import cross_validate_probes
from dreamfleet.worker.addons.inspection.subject import DriverChoice, choose_driver, find_subject
from dreamfleet.worker.addons.inspection.survival import SurvivalConfig, fixed_drivers, measure_survival
from dreamfleet.worker.dream.batch import DEFAULT_TEMPERATURE
from dreamfleet.worker.dream.world import world_of
from dreamfleet.worker.tasks.recordable import TaskWithBeginnings
from dreamfleet.worker.tasks.registry import task_of
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState


def measure_figures(request: measure.MeasureRequest, stop: Stop, on_figure: measure.OnFigure) -> measure.MeasureReport:
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
        found: dict[measure.FigureName, measure.FigureReport] = {}
        for name in measure.FIGURES:
            if name in request.figures:
                found[name] = _measure_one(name, request, bundle, driving, config, temperature, stop)
                on_figure(name, found[name])
    driver = driving.driver or (driving.controller.sha256 if driving.controller else None)
    return measure.MeasureReport(bundle.sha256, request.noise, request.seed, driver, found)


def _measure_one(
    name: measure.FigureName, request: measure.MeasureRequest, bundle: Bundle, driving: DriverChoice,
    config: DisturbedDriveConfig, temperature: float, stop: Stop,
) -> measure.FigureReport:  # fmt: skip
    default, unit = measure.UNITS[name]
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
            return cross_validate_probes(
                _first_drives(_drives(bundle, driving, config), count, on_count), config.opening
            )
        controller, losses = driving.dream_controller(bundle), RoadLossConfig(count, temperature=temperature)
        drives = _drives(bundle, driving, config)
        if name == "losses":
            lost = collect_losing_drives(drives, losses, config, on_count)
            return compare_losses(lost, bundle, controller, losses, config)
        first = _first_drives(drives, count, on_count)
        return compare_frequencies(first, bundle, controller, config.opening, losses.dreams, temperature)


def _drives(bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig) -> Iterator[DisturbedDrive]:
    recurrent = RecurrentState(driving.observing_model(bundle))
    return record_disturbed_drives(bundle, recurrent, driving.actors(bundle, recurrent), config)


def _first_drives(
    drives: Iterator[DisturbedDrive], count: int, on_drive: Callable[[int], None]
) -> list[DisturbedDrive]:
    found = []
    for drive in islice(drives, count):
        found.append(drive)
        on_drive(len(found))
    return found
