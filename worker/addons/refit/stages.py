"""Refitting a controller to another world model, and finding a subspace for a search, by recorded drives, as stages."""

import math
from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.cli.progress import progress_bar
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path, reporting_write_errors
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.stop_signals import Stop, never_stop, stopping
from dreamfleet.common.printable import plural
from dreamfleet.worker.training.stages import StageReport

DRIVES = 300


@dataclass(frozen=True)
class RefitRequest:
    """The controller (a file, a run, or one that ships) for the world model `to`, by the last `episodes` drives.

    `bundle` is the world model that it was evolved with, if that is not found.
    """

    controller: str
    to: str
    data: Path
    out: Path
    bundle: str | None = None
    episodes: int = DRIVES
    runs_dir: Path = Path("runs")

    def __post_init__(self) -> None:
        if self.episodes < 2:
            raise UsageError(f"--episodes must be at least 2, not {self.episodes}")


@dataclass(frozen=True)
class RefitReport(StageReport):
    """The fitted controller, the drives and steps it was fitted on, and R² of each value of its first layer.

    No drives: both models see and remember alike. R² is of held-out drives, and `None` where that is unknown.
    """

    controller: Path
    sha256: str
    bundle: str
    drives: int
    steps: int
    r_squared: tuple[float | None, ...]
    names: tuple[str, ...]  # of the values

    def __str__(self) -> str:
        if not self.drives:
            return f"{self.controller}: the same parameters, since both models see and remember alike"
        known = ["unknown" if each is None else f"{each:z.2f}" for each in self.r_squared]
        spoken = ", ".join(map(" ".join, zip(self.names, known, strict=False)))
        few = " (too few drives, or it never moves)" if None in self.r_squared else ""
        fitted = f"fitted on {plural(self.steps, 'step')} of {plural(self.drives, 'drive')}"
        return f"{self.controller}: {fitted}; R² on held-out ones: {spoken}{few}"


def refit_controller(request: RefitRequest, stop: Stop = never_stop) -> RefitReport:
    """Fit the controller and write it, with a progress bar on stderr; errors as in `refit`."""
    pin_thread_pools()  # of NumPy, which a verb has not loaded yet
    check_output_path(request.out)
    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
    from dreamfleet.worker.addons.refit.refit import output_names, refit
    from dreamfleet.worker.training.data.dataset import episode_paths

    controller, beside = find_controller(request.controller, request.runs_dir)
    own = find_bundle_of(controller, request.bundle, beside)
    if own is None:
        raise UsageError(f"controller {request.controller} sees no world model: give one that was evolved with one")
    paths = episode_paths(request.data)[-request.episodes :]  # controllers' drives are newer than random ones
    with progress_bar("refit", len(paths), "drives") as bar:
        fitted = refit(controller, own, find_bundle(request.to), paths, stopping(bar.update, stop))
    with reporting_write_errors(request.out):
        fitted.controller.save(request.out)
    r_squared = tuple(None if math.isnan(each) else round(each, 4) for each in fitted.r_squared)
    return RefitReport(
        request.out, fitted.controller.sha256, fitted.controller.bundle, fitted.drives, fitted.steps, r_squared,
        tuple(output_names(fitted.controller, own)),
    )  # fmt: skip


@dataclass(frozen=True)
class SubspaceRequest:
    """The features of the world model `bundle` (a file, or one that ships), by the last `episodes` drives at most.

    `views` are so many directions besides, which predict what the model itself will see and remember.
    """

    bundle: str
    data: Path
    out: Path
    episodes: int = DRIVES
    views: int = 0

    def __post_init__(self) -> None:
        if self.episodes < 5:
            raise UsageError(f"--episodes must be at least 5, not {self.episodes}: every fifth is held out")
        if self.views < 0:
            raise UsageError(f"--views must not be negative, not {self.views}")


@dataclass(frozen=True)
class SubspaceReport(StageReport):
    """The written subspace, its features with R² on held-out drives, and the drives and steps it was fitted on."""

    subspace: Path
    sha256: str
    bundle: str
    features: tuple[str, ...]
    r_squared: tuple[float, ...]
    drives: int
    steps: int

    def __str__(self) -> str:
        width = max(map(len, self.features))
        rows = [f"{name:<{width}}  {each:z.2f}" for name, each in zip(self.features, self.r_squared, strict=True)]
        heading = "what is predicted, how many steps ahead, and its R² on held-out drives:"
        fitted = f"by {plural(self.steps, 'step')} of {plural(self.drives, 'drive')}"
        return "\n".join([heading, *rows, f"{self.subspace}: {plural(len(rows), 'feature')}, {fitted}"])


def fit_subspace(request: SubspaceRequest, stop: Stop = never_stop) -> SubspaceReport:
    """Find the features and write the subspace, with a progress bar on stderr; errors as in `find_subspace`."""
    pin_thread_pools()  # of NumPy, which a verb has not loaded yet
    check_output_path(request.out)
    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.worker.addons.refit.fit_subspace import find_subspace
    from dreamfleet.worker.training.data.dataset import episode_paths

    bundle = find_bundle(request.bundle)
    paths = episode_paths(request.data)[-request.episodes :]  # controllers' drives are newer than random ones
    with progress_bar("subspace", len(paths), "drives") as bar:
        found = find_subspace(bundle, paths, stopping(bar.update, stop), request.views)
    r_squared = tuple(round(each, 4) for each in found.r_squared)
    with reporting_write_errors(request.out):
        found.subspace.save(request.out, {"drives": found.drives, "steps": found.steps, "r_squared": list(r_squared)})
    return SubspaceReport(
        request.out, found.subspace.sha256, bundle.sha256, tuple(found.subspace.names), r_squared, found.drives,
        found.steps,
    )  # fmt: skip
