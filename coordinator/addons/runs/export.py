"""Export a run's journal as CSV, Parquet or TensorBoard events. Pages: monitor.md, python.md, quality-diversity.md."""

import csv
import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from dreamfleet.common.addons.analysis.run_archive import RunArchive, tables
from dreamfleet.common.addons.analysis.scored_history import scored_history
from dreamfleet.common.errors import MissingExtraError, UsageError
from dreamfleet.common.files.atomic_write import open_output, reporting_write_errors
from dreamfleet.common.files.regular_files import is_file, is_folder
from dreamfleet.common.files.tensorboard import EVENTS, EXTRA, EventFileWriter, open_event_file
from dreamfleet.common.runs.records import (
    StoredCandidate,
    StoredConfirmation,
    StoredEvaluation,
    StoredGeneration,
    with_error,
)
from dreamfleet.common.runs.run_folder import RunFolder

Row = dict[str, Any]
TABLES: dict[str, tuple[type[Any], Callable[[RunFolder], Sequence[Any]]]] = {
    "generations": (StoredGeneration, scored_history),
    "candidates": (StoredCandidate, RunFolder.candidates),
    "evaluations": (StoredEvaluation, RunFolder.evaluations),
    "confirmation": (StoredConfirmation, lambda run: [each] if (each := run.confirmation()) else []),
}
ELITES = "elites"  # a table of its own columns, and a file of their parameters
JUDGED = ("evaluations", "confirmation")  # tables with a standard error


def export_csv(run: RunFolder, folder: Path) -> list[Path]:
    """Write `TABLE.csv` for each table with rows; return the paths."""

    def save(path: Path, columns: Sequence[str], rows: Sequence[Row]) -> None:
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, columns)
        writer.writerow({name: _as_cell(name) for name in columns})  # what lies below are numbers
        writer.writerows(rows)
        with open_output(path) as file:
            file.write(text.getvalue().encode())

    return _export_tables(run, folder, "csv", save)


def _as_cell(name: str) -> str:
    """The name as a cell that no spreadsheet takes for a formula."""
    return f"'{name}" if name.startswith(("=", "+", "-", "@")) else name


def export_parquet(run: RunFolder, folder: Path) -> list[Path]:
    """Write `TABLE.parquet` for each table with rows; return the paths. `MissingExtraError` without pyarrow."""
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"Parquet needs the package {error.name!r}: {EXTRA}") from error

    def save(path: Path, columns: Sequence[str], rows: Sequence[Row]) -> None:
        table = pa.table({name: [row[name] for row in rows] for name in columns})
        with open_output(path) as file:
            parquet.write_table(table, file)

    return _export_tables(run, folder, "parquet", save)


def export_tensorboard(run: RunFolder, folder: Path) -> list[Path]:
    """Write a TensorBoard event file; `UsageError` if the folder has one, since TensorBoard would merge both."""
    if is_folder(folder) and any(folder.glob(EVENTS)):
        raise UsageError(f"{folder} holds TensorBoard's events already: choose another --out")
    try:
        with open_event_file(folder) as events:
            add_settings(events, run)
            for step, numbers in scalars_of(run):
                events.add(step, **numbers)
    except BaseException:  # an incomplete file would block the next attempt
        for each in folder.glob(EVENTS):
            each.unlink(missing_ok=True)
        raise
    return sorted(folder.glob(EVENTS))


def add_settings(events: EventFileWriter, run: RunFolder) -> None:
    """Write a run's settings as a text."""
    events.add_text("settings", f"```\n{run.settings.to_json()}\n```")


def scalars_of(run: RunFolder, since: int = 0) -> Iterator[tuple[int, dict[str, float]]]:
    """What is drawn over generations: of each closed one from `since` on, then of every score of a mean.

    `__` in a name stands for the `/` that groups curves.
    """
    for each in scored_history(run, since):
        numbers = {
            "fitness__mean": each.mean, "fitness__std": each.std, "fitness__best": each.best,
            "fitness__worst": each.worst, "search__sigma": each.sigma, "effort__steps": each.steps,
            "effort__seconds": each.seconds,
        }  # fmt: skip
        yield each.number, {name: value for name, value in numbers.items() if not math.isnan(value)}
    for judged in run.evaluations():
        yield judged.generation, _score("evaluated", judged)
    if (confirmed := run.confirmation()) is not None:
        yield confirmed.generation, _score("confirmed", confirmed)


def _score(name: str, found: StoredEvaluation | StoredConfirmation) -> dict[str, float]:
    error = {} if found.error is None else {f"score__{name}_error": found.error}
    return {f"score__{name}": found.mean, **error}


def columns_of(table: str) -> list[str]:
    """The names of a table's columns."""
    kind, _ = TABLES[table]
    return [each.name for each in fields(kind)] + ["error"] * (table in JUDGED)


def rows_of(run: RunFolder, table: str) -> list[Row]:
    """A run's rows of a table; `None` stands for a fitness that there is none."""
    _, read = TABLES[table]
    rows = [with_error(each) if table in JUDGED else asdict(each) for each in read(run)]
    return [{name: None if value != value else value for name, value in row.items()} for row in rows]  # noqa: PLR0124


def _tables(run: RunFolder) -> Iterator[tuple[str, list[str], list[Row]]]:
    for name in TABLES:
        if rows := rows_of(run, name):
            yield name, columns_of(name), rows
    if (archive := RunArchive.of(run)) is not None and archive.elites:
        yield ELITES, *tables(archive)


def _export_tables(
    run: RunFolder, folder: Path, kind: str, save: Callable[[Path, Sequence[str], Sequence[Row]], None]
) -> list[Path]:
    """Write a file for each table with rows.

    `UsageError` if the folder has a file of the name of a table that has none: it would look like this run's.
    """
    with reporting_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    tables, written = list(_tables(run)), list[Path]()
    missing = {*TABLES, ELITES} - {name for name, _, _ in tables}
    others = [f"{name}.{kind}" for name in missing] + [f"{ELITES}.npz"] * (ELITES in missing)
    if strange := sorted(name for name in others if is_file(folder / name)):
        raise UsageError(
            f"{folder} holds {', '.join(strange)}, and run {run.name} has no such table: remove it, or choose another "
            "--out"
        )
    for name, columns, rows in tables:
        written.append(folder / f"{name}.{kind}")
        save(written[-1], columns, rows)
        if name == ELITES:
            written.append(folder / f"{ELITES}.npz")
            _save_elites(run, rows, written[-1])
    return written


def _save_elites(run: RunFolder, rows: Sequence[Row], path: Path) -> None:
    """Write the parameters `(elites, size)` of the table's rows, with its columns, as arrays of one `.npz`."""
    columns: dict[str, Any] = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    parameters = np.stack([run.candidate(row["generation"], row["candidate"]) for row in rows])
    with open_output(path) as file:
        np.savez(file, parameters=parameters, **columns)
