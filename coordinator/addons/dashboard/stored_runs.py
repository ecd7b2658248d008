"""The runs on this disk for the page: a list, and details of one. Only reads journals. `page/runs.js` shows them."""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import Any

from dreamfleet.common.addons.analysis.comparison import expand_task_options
from dreamfleet.common.addons.analysis.learning import efforts_until, world_of
from dreamfleet.common.addons.analysis.run_archive import RunArchive, describe_measure
from dreamfleet.common.addons.analysis.scored_history import scored_history
from dreamfleet.common.client.run_view import RunView
from dreamfleet.common.errors import DreamfleetError, JournalError
from dreamfleet.common.printable import format_duration, printable
from dreamfleet.common.protocol.tasks import is_function_task
from dreamfleet.common.runs.effort import Effort, format_steps
from dreamfleet.common.runs.records import RunSettings, StoredGeneration, format_mean, in_values
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_paths import resume_command, run_paths
from dreamfleet.common.runs.stages import stages_of
from dreamfleet.common.schema.times import format_time, parse_time
from dreamfleet.coordinator.addons.dashboard.curves import Quartiles, RunData, curves, downsample
from dreamfleet.coordinator.addons.dashboard.host_history import host_history
from dreamfleet.coordinator.addons.dashboard.page_state import NONE, Facts, tile
from dreamfleet.coordinator.addons.runs.run_details import count_failed, run_row, setting_rows, view_of

LAST = 20  # generations in the table
MOST_READ = 256 << 20  # bytes of candidates that are read for quartiles


def list_runs(runs_dir: Path) -> list[dict[str, Any]]:
    """A row for each run, by name; damaged journals included."""
    return [_run_row(path) for path in run_paths(runs_dir)]


def describe_run(runs_dir: Path, name: str) -> dict[str, Any]:
    """All details of one run; `JournalError` or `UsageError` if there is none or it is unreadable."""
    with open_run(runs_dir, name) as run, run.read_transaction():
        settings, history = run.settings, scored_history(run)
        if [each.number for each in history] != list(range(len(history))):
            raise JournalError(f"the journal of run {name} is damaged: generations are missing; restore it from a copy")
        data = RunData(settings, history, run.evaluations(), run.confirmation(), run.episode_limit)
        start, efforts = run.start_effort(), run.efforts()
        spent = list(efforts_until(range(len(history)), start, efforts))
        total = sum((each.effort for each in efforts), start)
        view, plain = view_of(run), expand_task_options(asdict(settings))
        rows = setting_rows(settings, plain, run.episode_limit)
        return {
            "run": run.name, "state": printable(run.state), "ended": run.ended is not None,
            "again": printable(resume_command(run.path)) if run.state == "open" else "",
            "tiles": _tiles(run, view, total), "facts": _about(run, view), "outcome": _outcome(run, view, total),
            "settings": [(name, printable(value), differs) for name, value, differs in rows], "world": _world(run),
            "curves": curves(data, read_quartiles(run, settings, downsample(history)), spent, view.word),
            "archive": describe_archive(RunArchive.of(run)),
            "generations": [_generation_row(in_values(each, run.spec)) for each in history[-LAST:][::-1]],
        }  # fmt: skip


def describe_hosts(runs_dir: Path, name: str) -> dict[str, Any]:
    """What each host of a run did over time; errors as `describe_run`."""
    with open_run(runs_dir, name) as run, run.read_transaction():
        state, ended = run.state, parse_time(run.ended_at or "")
        until = time.time() if state == "live" else None if ended is None else ended.timestamp()
        return {
            "run": run.name, "state": printable(state), "task": printable(run.spec.task),
            "classes": printable(run.classes.description),
            "checks": "" if run.checks is None else printable(run.checks.description),
            **host_history(run.effort_by_worker(), run.generation_times(), run.events(), until),
        }  # fmt: skip


def describe_archive(archive: RunArchive | None) -> dict[str, Any] | None:
    """What the heat map of an archive needs: middles of cells, fitness by row, titles; `None` without an archive."""
    if archive is None:
        return None
    first, second = archive.shown_axes
    more = ". Each cell shows its best over the other axes" if len(archive.axes) > 2 else ""
    return {
        "x": first.middles, "y": second.middles,
        "z": [[None if isnan(value) else value for value in row] for row in archive.grid().T.tolist()],
        "x_title": describe_measure(first.measure),
        "y_title": describe_measure(second.measure) if second.measure else "",
        "cells": _cell_texts(archive), "filled": len(archive.elites), "caption": printable(archive.description + more),
    }  # fmt: skip


def _cell_texts(archive: RunArchive) -> list[list[str]]:
    """What `--cell` takes for the elite that each cell of the picture shows, by row; empty without one."""
    best, (columns, rows) = archive.shown, (axis.cells for axis in archive.shown_axes)
    return [
        [",".join(map(str, best[column, row].cell)) if (column, row) in best else "" for column in range(columns)]
        for row in range(rows)
    ]


def read_quartiles(run: RunFolder, settings: RunSettings, drawn: Sequence[StoredGeneration]) -> Quartiles | None:
    """The fitness quartiles of these generations; `None` if they need more than `MOST_READ` bytes."""
    numbers = [each.number for each in drawn]
    largest = max(each.settings.population for each in stages_of(settings))
    if len(numbers) * largest * settings.controller.size * 4 > MOST_READ:
        return None
    return run.quartiles(numbers)


def _run_row(path: Path) -> dict[str, Any]:
    row = run_row(path, as_values=True)
    texts = {name: printable(row[name] or "") for name in ("run", "task", "state")}
    begun = None if row["created"] is None else format_time(row["created"])
    again = printable(resume_command(path)) if row["state"] == "open" else ""
    return {**row, **texts, "begun": begun, "again": again, "damaged": row["generations"] is None}


def _world(run: RunFolder) -> str:
    """The task that gives the scores, of a dream whose world model is gone the dream's."""
    with suppress(DreamfleetError, OSError):
        return printable(world_of(run))
    return printable(run.spec.task)


def _tiles(run: RunFolder, view: RunView, total: Effort) -> list[dict[str, str]]:
    reported, best = view.reported, view.best
    tiles = [tile("score", NONE, "no mean was evaluated") if reported is None
             else tile("score", format_mean(reported), view.caption(reported))]  # fmt: skip
    if view.confirmed is not None and best is not None:
        tiles.append(tile("best evaluation", format_mean(best), view.caption(best)))
    passed = "" if run.duration_seconds is None else f"in {format_duration(run.duration_seconds)}"
    dreamt = f"{format_steps(total.dreamt)} dreamt" if total.dreamt else ""
    return [
        *tiles,
        tile("generations", f"{len(run.history()):,}", passed),
        tile("calls" if is_function_task(view.task.task) else "steps in reality", format_steps(total.steps), dreamt),
        tile("core-hours", f"{total.core_hours:.3g}", printable(run.classes.description)),
    ]


def _about(run: RunFolder, view: RunView) -> Facts:
    settings, world = view.settings, _world(run)
    facts = [
        ("task", view.about),
        *([("world", world)] if world != view.task.task else []),
        ("begun", format_time(run.created)),
        *([("ended", format_time(run.ended_at))] if run.ended_at else []),
        ("population", view.population),
        ("optimiser", view.optimiser),
        *([] if settings.is_external else [("first step size", f"{settings.sigma0:g}")]),
        ("seed", str(settings.seed)),
        *([] if run.checks is None else [("checks", run.checks.description)]),
    ]
    return [(name, printable(value)) for name, value in facts]


def _outcome(run: RunFolder, view: RunView, total: Effort) -> Facts:
    """What it came to, in words that stand beside another run's."""
    history = run.history()
    facts = [
        ("generations", f"{len(history):,}"),
        ("failed candidates", f"{count_failed(history):,}"),
        ("spent", total.describe(view.task.task)),
        ("hosts", run.classes.description),
        ("best evaluation", view.describe(view.best)),
        ("confirmed", view.describe(view.confirmed)),
    ]
    return [(name, printable(value)) for name, value in facts]


def _generation_row(each: StoredGeneration) -> dict[str, Any]:
    fitness = {name: getattr(each, name) for name in ("mean", "std", "best", "worst")}
    return {
        "generation": each.number, **{name: None if isnan(value) else value for name, value in fitness.items()},
        "sigma": each.sigma, "failed": each.failed or None, "steps": each.steps, "seconds": each.seconds,
    }  # fmt: skip
