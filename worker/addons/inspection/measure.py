"""Figures of a world model as a stage: a typed request in, a typed report out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.runs.seeds import VALIDATION

if TYPE_CHECKING:
    from dreamfleet.worker.addons.inspection.dream_comparisons import LikenessReport, LossReport
    from dreamfleet.worker.addons.inspection.probe import Knowledge
    from dreamfleet.worker.addons.inspection.survival import Survival

FigureReport: TypeAlias = "Survival | Knowledge | LikenessReport | LossReport"
FigureName = Literal["survival", "probe", "likeness", "losses"]  # worker/training/assemble.py keeps some
FIGURES: tuple[FigureName, ...] = get_args(FigureName)  # in the order of measuring
OnFigure: TypeAlias = "Callable[[FigureName, FigureReport], None]"
DRIVES, LOSSES, LIVES = 20, 30, 40
UNITS = {"survival": (LIVES, "episodes"), "probe": (DRIVES, "drives"), "likeness": (DRIVES, "drives"),
         "losses": (LOSSES, "losses")}  # fmt: skip
FEWEST_DRIVES, FEWEST_LOSSES = 2, 4  # also in experiments/iteration/config.py, which imports no journal


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
        found: dict[str, Any] = plain.pop("found")
        return plain | found


def measure(
    request: MeasureRequest, stop: Stop = never_stop, on_figure: OnFigure = lambda _name, _found: None
) -> MeasureReport:
    """Measure the figures, with progress bars on stderr; `on_figure` gets each at once.

    `UsageError` for what cannot be measured; `StoppedError` if `stop` asks for a stop: nothing is kept.
    """
    draw_unseen()
    pin_thread_pools()  # of NumPy, which a verb has not loaded yet
    from dreamfleet.worker.addons.inspection.measurements import measure_figures

    return measure_figures(request, stop, on_figure)
