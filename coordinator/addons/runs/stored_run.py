"""A run as users' programs hold it: its journal as typed records, tables and plots, and its controller."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from dreamfleet.common.addons.analysis.run_archive import RunArchive, controller_of, tables
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import JournalError, MissingExtraError, UsageError
from dreamfleet.common.host.packages import install_command
from dreamfleet.common.printable import plural
from dreamfleet.common.runs import run_folder, run_paths
from dreamfleet.common.runs.lookup import load_controller_of
from dreamfleet.common.runs.records import best_evaluation, format_mean, in_values
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.schema.display import Displayed
from dreamfleet.coordinator.addons.runs.export import ELITES, TABLES, columns_of, rows_of

if TYPE_CHECKING:
    import pandas
    import polars
    from matplotlib.figure import Figure

Plot = Literal["fitness", "learning", "archive"]
TableName = Literal["generations", "candidates", "evaluations", "confirmation", "elites"]
PLOTS: tuple[Plot, ...] = get_args(Plot)


class StoredRun(RunFolder, Displayed):
    """A run's journal, read-only, as `open_run` opens it. It may be live; close it, or use it in a `with`.

    >>> from dreamfleet import open_run
    >>> with open_run("cartpole") as run:  # begun by `dreamfleet coordinator --run cartpole --task gym:CartPole-v1`
    ...     generation = run.history()[0]
    ...     print(run.spec.task, generation.number, generation.worst <= generation.mean <= generation.best)
    ...     print(run.controller().task, run.bundle())
    gym:CartPole-v1 0 True
    gym:CartPole-v1 None
    """

    def _display(self) -> tuple[str, dict[str, object]]:
        facts: dict[str, object] = {"folder": str(self.path)}
        try:
            with self.read_transaction():
                count, confirmed, best = len(self.history()), self.confirmation(), best_evaluation(self.evaluations())
                spec, state = self.spec, self.state
        except JournalError as error:  # closed, or damaged
            return f"Run {self.name}: {error}", facts
        facts |= {
            "task": spec.task,
            "state": state,
            "generations": count,
            "best evaluation": best and format_mean(in_values(best, spec)),
            "confirmed": confirmed and format_mean(in_values(confirmed, spec)),
            "begun": self.created,
        }
        return f"Run {self.name} of {spec.task}: {plural(count, 'generation')}, {state}", facts

    def controller(self) -> Controller:
        """The controller that the run reports; `ControllerError` before its first generation is closed."""
        return load_controller_of(self)

    def bundle(self) -> Bundle | None:
        """The run's own copy of its world model, for `evaluate` and `predict`; `None` if it has none."""
        return Bundle.open(self.bundle_path, self.spec.bundle) if self.spec.bundle else None

    def archive(self) -> RunArchive | None:
        """The best candidate of each cell, of a run with `--archive`; `None` for another one."""
        return RunArchive.of(self)

    def elite(self, cell: str) -> Controller:
        """The elite of a cell of the archive, as `evaluate --cell` names it: `3,7`, or a value for each measure.

        `UsageError` for an empty cell, or a run without an archive.
        """
        return controller_of(self, RunArchive.needed(self).find(cell))

    def to_pandas(self, table: TableName = "generations") -> pandas.DataFrame:
        """A table as a pandas `DataFrame`: `generations`, `candidates`, `evaluations`, `confirmation` or `elites`.

        These are the tables of `dreamfleet runs export`. `MissingExtraError` without pandas.

        >>> from dreamfleet import open_run
        >>> with open_run("cartpole") as run:
        ...     frame = run.to_pandas()
        >>> list(frame.columns)[:4]
        ['number', 'mean', 'std', 'best']
        """
        frame: pandas.DataFrame = self._to_frame("pandas", table)
        return frame

    def to_polars(self, table: TableName = "generations") -> polars.DataFrame:
        """The same as a polars `DataFrame`; `MissingExtraError` without polars."""
        frame: polars.DataFrame = self._to_frame("polars", table)
        return frame

    def plot(self, kind: Plot = "fitness") -> Figure:
        """The picture of `dreamfleet runs plot`, as a matplotlib `Figure`, which notebooks show.

        `fitness` is that of the candidates over generations, with the evaluated means. `learning` is the evaluated
        score over environment steps and core-hours, `archive` the elites of a run with an archive. `MissingExtraError`
        without matplotlib, `UsageError` while there is nothing to draw.

        >>> from dreamfleet import open_run
        >>> with open_run("cartpole") as run:
        ...     figure = run.plot()
        >>> figure.savefig("fitness.png")
        """
        if kind not in PLOTS:
            raise UsageError(f"kind must be {' or '.join(PLOTS)}, not {kind!r}")
        _import("matplotlib", install_command("views"))
        from dreamfleet.coordinator.addons.runs.plot import draw_runs

        with self.verified_transaction():
            return draw_runs([self], kind)

    def _to_frame(self, package: str, table: str) -> Any:
        if table not in (*TABLES, ELITES):
            raise UsageError(f"table must be one of {', '.join((*TABLES, ELITES))}, not {table!r}")
        make: Callable[[dict[str, list[Any]]], Any] = _import(package, f"pip install {package}").DataFrame
        with self.verified_transaction():
            is_archive = table == ELITES
            columns, rows = tables(RunArchive.needed(self)) if is_archive else (columns_of(table), rows_of(self, table))
        return make({name: [row[name] for row in rows] for name in columns})


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
