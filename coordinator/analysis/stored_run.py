"""A run as users' programs hold it: its journal as typed records, tables and plots, and its controller."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import ControllerError, MissingExtraError, UsageError
from dreamfleet.common.host.packages import install_command
from dreamfleet.common.runs import run_folder, run_paths
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.analysis.export import TABLES, columns_of, rows_of

Plot = Literal["learning", "fitness"]
PLOTS: tuple[Plot, ...] = get_args(Plot)


class StoredRun(RunFolder):
    """A run's journal, read-only, as `open_run` opens it. It may be live; close it, or use it in a `with`.

    >>> from dreamfleet import open_run
    >>> with open_run("cartpole") as run:  # begun by `dreamfleet coordinator --run cartpole --task gym:CartPole-v1`
    ...     generation = run.history()[0]
    ...     print(run.spec.task, generation.number, generation.worst <= generation.mean <= generation.best)
    ...     print(run.controller().task, run.bundle())
    gym:CartPole-v1 0 True
    gym:CartPole-v1 None
    """

    def controller(self) -> Controller:
        """The controller that the run reports; `ControllerError` before its first generation is closed."""
        try:
            return Controller.load(self.controller_path)
        except ControllerError as error:
            if self.history():
                raise
            raise ControllerError(f"run {self.name} has no controller before its first generation is closed") from error

    def bundle(self) -> Bundle | None:
        """The run's own copy of its world model, for `evaluate` and `predict`; `None` if it has none."""
        return Bundle.open(self.bundle_path, self.spec.bundle) if self.spec.bundle else None

    def to_pandas(self, table: str = "generations") -> Any:
        """A table as a pandas `DataFrame`: `generations`, `candidates`, `evaluations` or `confirmation`.

        These are the tables of `dreamfleet runs export`. `MissingExtraError` without pandas.

        >>> from dreamfleet import open_run
        >>> with open_run("cartpole") as run:
        ...     frame = run.to_pandas()
        >>> list(frame.columns)[:4]
        ['number', 'mean', 'std', 'best']
        """
        return self._to_frame("pandas", table)

    def to_polars(self, table: str = "generations") -> Any:
        """The same as a polars `DataFrame`; `MissingExtraError` without polars."""
        return self._to_frame("polars", table)

    def plot(self, kind: Plot | None = None) -> Any:
        """The picture of `dreamfleet runs plot`, as a matplotlib `Figure`, which notebooks show.

        `learning` is the evaluated score over environment steps and core-hours, `fitness` that of the candidates over
        generations. By default `learning`, where a mean was evaluated. `MissingExtraError` without matplotlib,
        `UsageError` while there is nothing to draw.

        >>> from dreamfleet import open_run
        >>> with open_run("cartpole") as run:
        ...     figure = run.plot()
        >>> figure.savefig("learning.png")
        """
        from dreamfleet.common.runs.learning import LearningCurve

        if kind not in (None, *PLOTS):
            raise UsageError(f"kind must be {' or '.join(PLOTS)}, not {kind!r}")
        _import("matplotlib", install_command("views"))
        from dreamfleet.coordinator.analysis.plot import fitness_figure, learning_figure, published_scores

        with self.read_transaction():
            if kind == "fitness" or (kind is None and not self.evaluations()):
                return fitness_figure(self)
            curves = [LearningCurve.of(self)]
            return learning_figure(curves, published_scores(curves))

    def _to_frame(self, package: str, table: str) -> Any:
        if table not in TABLES:
            raise UsageError(f"table must be one of {', '.join(TABLES)}, not {table!r}")
        make: Callable[[dict[str, list[Any]]], Any] = _import(package, f"pip install {package}").DataFrame
        with self.read_transaction():
            rows = rows_of(self, table)
        return make({name: [row[name] for row in rows] for name in columns_of(table)})


def open_run(name: str, runs_dir: Path | str | None = None) -> StoredRun:
    """A run's journal, read-only; close it or use it in a `with`. `JournalError` lists the existing runs.

    >>> from dreamfleet import open_run
    >>> with open_run("cartpole") as run:  # the name of a run of yours
    ...     print(run.spec.task, len(run.history()) > 0)
    gym:CartPole-v1 True
    """
    folder = run_paths.default_runs_dir() if runs_dir is None else Path(runs_dir)
    with run_folder.open_run(folder, name) as found:
        return StoredRun(found.path)


def _import(package: str, remedy: str) -> Any:
    try:
        return import_module(package)
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"this needs the package {error.name!r}: {remedy}") from error
