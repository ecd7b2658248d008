"""The runs on this disk for the page: a list, and details of one. Only reads journals."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import Any

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.objective import describe_sign
from dreamfleet.common.client.elites import Elite, EliteArchive
from dreamfleet.common.client.eta import format_duration
from dreamfleet.common.errors import DreamfleetError, JournalError
from dreamfleet.common.printable import format_setting, plural, printable
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.measures import Axis, describe_measure
from dreamfleet.common.protocol.tasks import DREAM, is_function_task
from dreamfleet.common.runs.effort import Effort, format_steps
from dreamfleet.common.runs.records import (
    SUBMITTED,
    RunSettings,
    StoredGeneration,
    best_evaluation,
    count_episodes,
    expand_task_options,
    in_values,
)
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.run_paths import resume_command, run_paths
from dreamfleet.common.runs.stages import describe_limit, stages_of
from dreamfleet.common.schema.times import format_time, parse_time
from dreamfleet.common.worlds.score_words import score_word_of_run
from dreamfleet.coordinator.addons.dashboard.curves import Quartiles, RunData, cumulative_effort, curves, downsample
from dreamfleet.coordinator.addons.dashboard.host_history import host_history
from dreamfleet.coordinator.addons.dashboard.page_state import (
    NONE,
    Facts,
    describe_optimiser,
    format_score,
    reported_caption,
    tile,
)

COLUMNS = (
    "run", "created", "begun", "task", "generations", "mean", "best", "confirmed", "best_error", "confirmed_error",
    "again", "state", "ended", "damaged",
)  # fmt: skip
LAST = 20  # generations in the table
MOST_READ = 256 << 20  # bytes of candidates that are read for quartiles


def list_runs(runs_dir: Path) -> list[dict[str, Any]]:
    """A row for each run, by name; damaged journals included."""
    return [_run_row(path) for path in run_paths(runs_dir)]


def describe_run(runs_dir: Path, name: str) -> dict[str, Any]:
    """All details of one run; `JournalError` or `UsageError` if there is none or it is unreadable."""
    with open_run(runs_dir, name) as run, run.read_transaction():
        settings, history = run.settings, run.history()
        if [each.number for each in history] != list(range(len(history))):
            raise JournalError(f"the journal of run {name} is damaged: generations are missing; restore it from a copy")
        data = RunData(settings, history, run.evaluations(), run.confirmation(), run.episode_limit)
        start, efforts = run.start_effort(), run.efforts()
        spent = cumulative_effort(start, efforts, len(history))
        total = sum((each.effort for each in efforts), start)
        word = score_word_of_run(run.spec, run.bundle_path)
        return {
            "run": run.name, "state": printable(run.state), "ended": run.ended is not None,
            "tiles": _tiles(run, data, total, word), "again": _resume_command(run), "facts": _about(run, settings),
            "outcome": _outcome(run, data, total, word), "settings": flatten_settings(settings), "world": _world(run),
            "curves": curves(data, read_quartiles(run, settings, downsample(history)), spent, word),
            "archive": describe_archive(EliteArchive.of(run)),
            "generations": [_generation_row(in_values(each, run.spec)) for each in history[-LAST:][::-1]],
        }  # fmt: skip


def describe_hosts(runs_dir: Path, name: str) -> dict[str, Any]:
    """What each host of a run did over time; errors as `describe_run`."""
    with open_run(runs_dir, name) as run, run.read_transaction():
        state, ended = run.state, parse_time(run.ended_at or "")
        until = time.time() if state == "live" else None if ended is None else ended.timestamp()
        return {
            "run": run.name,
            "state": printable(state),
            "classes": printable(run.classes.description),
            "checks": "" if run.checks is None else printable(run.checks.description),
            "task": printable(run.spec.task),
            **host_history(run.work_by_worker(), run.generation_times(), run.events(), until),
        }


def describe_archive(archive: EliteArchive | None) -> dict[str, Any] | None:
    """What the heat map of an archive needs: middles of cells, fitness by row, titles; `None` without an archive."""
    if archive is None:
        return None
    first, second = (*archive.axes, Axis("", 0, 1, 1))[:2]
    more = ". Each cell shows its best over the other axes" if len(archive.axes) > 2 else ""
    return {
        "x": first.middles, "y": second.middles,
        "z": [[None if isnan(value) else value for value in row] for row in archive.grid().T.tolist()],
        "x_title": describe_measure(first.measure),
        "y_title": describe_measure(second.measure) if second.measure else "",
        "cells": _cell_texts(archive), "filled": len(archive.elites), "caption": printable(archive.description + more),
    }  # fmt: skip


def _cell_texts(archive: EliteArchive) -> list[list[str]]:
    """What `--cell` takes for the elite that each cell of the picture shows, by row; empty without one."""
    best: dict[tuple[int, ...], Elite] = {}
    for elite in archive.elites.values():
        place = (*elite.cell, 0)[:2]
        if place not in best or elite.fitness > best[place].fitness:
            best[place] = elite
    columns, rows = (*(axis.cells for axis in archive.axes), 1)[:2]
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


def flatten_settings(settings: RunSettings) -> Facts:
    """Every setting by its dotted name."""
    rows: Facts = []

    def walk(prefix: str, value: object) -> None:
        if isinstance(value, dict):
            for name, inner in value.items():
                walk(f"{prefix}.{name}" if prefix else str(name), inner)
        elif isinstance(value, (list, tuple)) and value and isinstance(value[0], dict):
            for number, inner in enumerate(value, 1):
                walk(f"{prefix}.{number}", inner)
        elif value not in (None, "", ()):
            rows.append((prefix, printable(format_setting(value))))

    walk("", expand_task_options(asdict(settings)))
    return rows


def _run_row(path: Path) -> dict[str, Any]:
    try:
        with RunFolder(path) as run:
            spec, history = run.spec, run.history()
            judged = best_evaluation(run.evaluations()), run.confirmation()
            best, confirmed = (in_values(each, spec) for each in judged)
            return {
                "run": printable(run.name), "created": run.created, "begun": format_time(run.created),
                "task": printable(spec.task), "generations": len(history),
                "mean": value_of(history[-1].mean, spec) if history else None,
                "best": best and best.mean, "best_error": best and best.error,
                "confirmed": confirmed and confirmed.mean, "confirmed_error": confirmed and confirmed.error,
                "again": _resume_command(run), "state": printable(run.state), "ended": run.ended is not None,
                "damaged": False,
            }  # fmt: skip
    except JournalError as error:
        return {**dict.fromkeys(COLUMNS), "run": printable(path.name), "state": printable(str(error)), "damaged": True}


def _resume_command(run: RunFolder) -> str:
    """The command that resumes an open run; empty for live and ended runs."""
    return printable(resume_command(run.path)) if run.state == "open" else ""


def _world(run: RunFolder) -> str:
    """The task that gives the scores; for a dream, the task of its world model."""
    task = run.spec.task
    if task == DREAM:
        with suppress(DreamfleetError, OSError):  # its world model may be gone
            task = Bundle.open(run.bundle_path, run.spec.bundle).manifest.task
    return printable(task)


def _tiles(run: RunFolder, data: RunData, total: Effort, word: str) -> list[dict[str, str]]:
    best, confirmed = (in_values(each, run.spec) for each in (best_evaluation(data.evaluations), data.confirmed))
    reported = confirmed or best
    tiles = [
        tile("score", NONE, "no mean was evaluated") if reported is None
        else tile("score", format_score(reported), reported_caption(reported, word)),
    ]  # fmt: skip
    if confirmed is not None and best is not None:
        tiles.append(tile("best evaluation", format_score(best), reported_caption(best, word)))
    lasted = run.duration_seconds
    passed = "" if lasted is None else f"in {format_duration(lasted)}"
    dreamt, task = f"{format_steps(total.dreamt)} dreamt" if total.dreamt else "", run.spec.task
    return [
        *tiles,
        tile("generations", f"{len(data.history):,}", passed),
        tile("calls" if is_function_task(task) else "steps in reality", format_steps(total.steps), dreamt),
        tile("core-hours", f"{total.core_hours:.3g}", printable(run.classes.description)),
    ]


def _about(run: RunFolder, settings: RunSettings) -> Facts:
    task, world = settings.task.task, _world(run)
    limit, horizon = run.episode_limit, settings.task.horizon
    steps = f"{min(horizon, limit or horizon):,} steps{describe_limit(horizon, limit)}"
    population = f"{plural(settings.population, 'candidate')}, {plural(settings.episodes, 'episode')} each"
    facts = [
        ("task", ", ".join(filter(None, (task, describe_sign(settings.task.options))))),
        *([("world", world)] if world != task else []),
        ("begun", format_time(run.created)),
        *([("ended", format_time(run.ended_at))] if run.ended_at else []),
        ("population", SUBMITTED if settings.is_external else population),
        *([] if is_function_task(task) else [("horizon", steps)]),
        ("optimiser", describe_optimiser(settings)),
        *([] if settings.is_external else [("first step size", f"{settings.sigma0:g}")]),
        ("seed", str(settings.seed)),
        *([] if run.checks is None else [("checks", run.checks.description)]),
    ]
    return [(name, printable(value)) for name, value in facts]


def _outcome(run: RunFolder, data: RunData, total: Effort, word: str) -> Facts:
    """What it came to, in words that stand beside another run's."""
    best, confirmed = (in_values(each, run.spec) for each in (best_evaluation(data.evaluations), data.confirmed))
    failed = sum(each.failed for each in data.history)
    facts = [
        ("generations", f"{len(data.history):,}"),
        ("failed candidates", f"{failed:,}"),
        ("spent", total.describe(run.spec.task)),
        ("hosts", run.classes.description),
        ("best evaluation", NONE if best is None else
         f"{format_score(best)} on {count_episodes(best, word)}, generation {best.generation}"),
        ("confirmed", NONE if confirmed is None else
         f"{format_score(confirmed)} on {count_episodes(confirmed, f'fresh {word}')}"),
    ]  # fmt: skip
    return [(name, printable(value)) for name, value in facts]


def _generation_row(each: StoredGeneration) -> dict[str, Any]:
    return {
        "generation": each.number, "mean": each.mean, "std": each.std, "best": each.best, "worst": each.worst,
        "sigma": each.sigma, "failed": each.failed or None, "steps": each.steps, "seconds": each.seconds,
    }  # fmt: skip
