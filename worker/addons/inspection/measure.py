"""Figures of a world model as a stage: a typed request in, a typed report out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.stop_signals import Stop, never_stop, stopping
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.runs.seeds import VALIDATION

if TYPE_CHECKING:
    from dreamfleet.common.artifacts.bundle import Bundle
    from dreamfleet.worker.addons.inspection.disturbed_rollouts import DisturbedDriveConfig
    from dreamfleet.worker.addons.inspection.knowledge import Knowledge
    from dreamfleet.worker.addons.inspection.likeness import LikenessReport
    from dreamfleet.worker.addons.inspection.measurements import DriverChoice
    from dreamfleet.worker.addons.inspection.page_builder import InspectionSubject
    from dreamfleet.worker.addons.inspection.road_losses import LossReport
    from dreamfleet.worker.addons.inspection.survival import Survival

FigureReport: TypeAlias = "Survival | Knowledge | LikenessReport | LossReport"
FigureName = Literal["survival", "probe", "likeness", "losses"]
FIGURES: tuple[FigureName, ...] = ("survival", "probe", "likeness", "losses")  # in the order of measuring
DRIVES, LOSSES, LIVES = 20, 30, 40
UNITS = {"survival": (LIVES, "episodes"), "probe": (DRIVES, "drives"), "likeness": (DRIVES, "drives"),
         "losses": (LOSSES, "losses")}  # fmt: skip
FEWEST_DRIVES, FEWEST_LOSSES = 2, 4


@dataclass(frozen=True)
class MeasureRequest:
    """Figures of the world model of `subject`, a bundle or a run; of none: of the controller's own.

    The `controller`, or the random `driver`, drives; `None`: the run's. `episodes` are drives of the probe and the
    likeness, losses, or episodes of each policy. `noise` is in halves of an action's range. `temperature` of dreams:
    `None` is the run's, else 1. `end` is when dreams of `survival` end; empty: as the bundle says.
    """

    figures: tuple[FigureName, ...]
    subject: str | None = None
    controller: str | None = None
    driver: str | None = None
    episodes: int | None = None
    seed: int = VALIDATION.start
    noise: float = 0.3
    temperature: float | None = None
    end: str = ""
    runs_dir: Path = Path("runs")

    def __post_init__(self) -> None:
        losses = "losses" in self.figures
        fewest, what = (FEWEST_LOSSES, "losses, for --losses") if losses else (FEWEST_DRIVES, "drives")
        if self.episodes is not None and self.episodes < fewest:
            raise UsageError(f"--episodes must be at least {fewest} {what}, not {self.episodes}")
        if self.seed < 0 or not 0 <= self.noise <= 10:
            raise UsageError("--seed must be at least 0, --noise from 0 to 10")
        if self.driver and "survival" in self.figures:
            raise UsageError("--survival measures all drivers: omit --driver")
        if self.controller and self.driver:
            raise UsageError("only one can drive: give --controller or --driver")


@dataclass(frozen=True)
class MeasureReport:
    """What was measured, by figure, of which world model (its SHA-256), and under which driver and noise."""

    bundle: str
    noise: float
    first_seed: int
    driver: str | None
    found: Mapping[FigureName, FigureReport]

    @property
    def facts(self) -> dict[str, Any]:
        """All as values by name, as `inspect --json` prints them."""
        plain = asdict(self)
        return {**{name: value for name, value in plain.items() if name != "found"}, **plain["found"]}


def measure(
    request: MeasureRequest, stop: Stop = never_stop,
    on_figure: Callable[[FigureName, FigureReport], None] = lambda _name, _found: None,
) -> MeasureReport:  # fmt: skip
    """Measure the figures, with progress bars on stderr; `on_figure` gets each at once.

    `UsageError` for what cannot be measured; `StoppedError` if `stop` asks for a stop: nothing is kept.
    """
    draw_unseen()
    pin_thread_pools()  # of NumPy, which a verb has not loaded yet
    from dreamfleet.worker.addons.inspection.disturbed_rollouts import DisturbedDriveConfig
    from dreamfleet.worker.dream.world import world_of
    from dreamfleet.worker.tasks.recordable import TaskWithBeginnings
    from dreamfleet.worker.tasks.registry import task_of

    with ExitStack() as held:
        subject = open_subject(request.subject, request.runs_dir, held)
        if request.subject and subject.bundle is None:
            raise UsageError(f"run {request.subject} has no world model to measure: name a bundle, or a run with one")
        bundle, driving = _choose(request, subject)
        anywhere = bool(driving.driver) and isinstance(task_of(bundle), TaskWithBeginnings)
        config = DisturbedDriveConfig(
            request.noise, first_seed=request.seed, opening=world_of(bundle).opening, anywhere=anywhere
        )
        temperature = _temperature(request, subject)
        found: dict[FigureName, FigureReport] = {}
        for name in FIGURES:
            if name in request.figures:
                found[name] = _measure_one(name, request, bundle, driving, config, temperature, stop)
                on_figure(name, found[name])
    driver = driving.driver or (driving.controller.sha256 if driving.controller else None)
    return MeasureReport(bundle.sha256, request.noise, request.seed, driver, found)


def open_subject(name: str | None, runs_dir: Path, held: ExitStack) -> InspectionSubject:
    """The bundle or run of this name, open until `held` closes; without a name nothing."""
    from dreamfleet.worker.addons.inspection.page_builder import InspectionSubject, find_subject

    return held.enter_context(find_subject(name, runs_dir)) if name else InspectionSubject(None)


def choose_driver(
    subject: InspectionSubject, controller_name: str | None, runs_dir: Path
) -> tuple[Bundle, DriverChoice]:
    """The world model to look into, and the controller that drives: the named one, else the subject's own."""
    from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
    from dreamfleet.worker.addons.inspection.measurements import DriverChoice

    controller, own = subject.controller, subject.bundle
    if controller_name:
        controller, beside = find_controller(controller_name, runs_dir)
        if own is None or controller.bundle != own.sha256:
            own = find_bundle_of(controller, None, beside)
    bundle = subject.bundle or own
    if bundle is None:
        raise UsageError("give a bundle or a run to measure, or a --controller that has a world model")
    return bundle, DriverChoice(controller, own)


def _choose(request: MeasureRequest, subject: InspectionSubject) -> tuple[Bundle, DriverChoice]:
    from dreamfleet.worker.addons.inspection.measurements import DriverChoice

    bundle, driving = choose_driver(subject, request.controller, request.runs_dir)
    if request.driver:
        return bundle, DriverChoice(driver=request.driver)
    if driving.controller is None and request.figures != ("survival",):
        raise UsageError("name who drives: --controller, or for --probe a --driver")
    return bundle, driving


def _temperature(request: MeasureRequest, subject: InspectionSubject) -> float:
    from dreamfleet.worker.dream.batch import DEFAULT_TEMPERATURE

    if request.temperature is not None:
        return request.temperature
    return (subject.run.spec.temperature if subject.run else 0.0) or DEFAULT_TEMPERATURE


def _measure_one(
    name: FigureName, request: MeasureRequest, bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig,
    temperature: float, stop: Stop,
) -> FigureReport:  # fmt: skip
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.addons.inspection.measurements import likeness, measure_dream_losses, probe
    from dreamfleet.worker.addons.inspection.road_losses import RoadLossConfig
    from dreamfleet.worker.addons.inspection.survival import SurvivalConfig, fixed_drivers, measure_survival
    from dreamfleet.worker.dream.world import world_of
    from dreamfleet.worker.tasks.registry import task_of

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
            return probe(bundle, driving, config, count, on_count)
        if name == "likeness":
            return likeness(bundle, driving, config, RoadLossConfig(temperature=temperature), count, on_count)
        return measure_dream_losses(bundle, driving, config, RoadLossConfig(count, temperature=temperature), on_count)
