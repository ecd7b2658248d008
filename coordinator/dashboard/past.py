"""Runs on this disk as the page shows them: a list, and one run whole. Only reads journals."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.effort import START_EFFORT, Effort, start_effort
from dreamfleet.common.errors import DreamfleetError, JournalError
from dreamfleet.common.printable import plural, printable, setting
from dreamfleet.common.runs import RunFolder, open_run, run_paths
from dreamfleet.common.stages import stages_of
from dreamfleet.common.stored import RunSettings, StoredGeneration, best_of, told, unfolded
from dreamfleet.common.tasks import DREAM
from dreamfleet.coordinator.dashboard.curves import Course, Quartiles, cumulated, curves, sampled
from dreamfleet.coordinator.dashboard.frames import NONE, Facts, again, optimiser, score

COLUMNS = (
    "run", "created", "begun", "task", "generations", "mean", "best", "confirmed", "best_error", "confirmed_error",
    "again", "state", "damaged",
)  # fmt: skip
LAST = 20  # generations that are listed one by one
MOST_READ = 256 << 20  # bytes of candidates that are looked at for their quartiles; beyond it takes too long


def listed(runs_dir: Path) -> list[dict[str, Any]]:
    """A row for each run, by name; a damaged journal is a row too."""
    return [_row(path) for path in run_paths(runs_dir)]


def one(runs_dir: Path, name: str) -> dict[str, Any]:
    """One run; `JournalError` or `UsageError` where there is no such run, or it cannot be read."""
    with open_run(runs_dir, name) as run, run.at_one_moment():
        settings, history = run.settings, run.history()
        if [each.number for each in history] != list(range(len(history))):
            raise JournalError(f"the journal of run {name} is damaged: generations are missing; restore it from a copy")
        course = Course(settings, history, run.evaluations(), run.confirmation())
        start = start_effort(run.fact(START_EFFORT)) or Effort()
        efforts = run.efforts()
        spent = cumulated(start, efforts, len(history))
        total = sum((each.effort for each in efforts), start)
        reported = course.confirmed or best_of(course.evaluations)
        return {
            "run": run.name,
            "state": printable(run.state),
            "sentence": printable(f"{run.state}; {told(reported) if reported else 'no mean was evaluated'}"),
            "again": _again(run),
            "facts": _facts(run, course, total),
            "settings": flat(settings),
            "world": _world(run),
            "curves": curves(course, quartiles_of(run, settings, sampled(history)), spent),
            "generations": [_generation(each) for each in history[-LAST:][::-1]],
        }


def quartiles_of(run: RunFolder, settings: RunSettings, drawn: Sequence[StoredGeneration]) -> Quartiles | None:
    """Those of the generations that are drawn; `None` where there would be too much to read."""
    numbers = [each.number for each in drawn]
    largest = max(each.population for each in stages_of(settings))
    if len(numbers) * largest * settings.controller.size * 4 > MOST_READ:
        return None
    return run.quartiles(numbers)


def flat(settings: RunSettings) -> Facts:
    """Every setting by its name, those of a part with the part's name before it."""
    rows: Facts = []

    def walk(prefix: str, value: object) -> None:
        if isinstance(value, dict):
            for name, inner in value.items():
                walk(f"{prefix}.{name}" if prefix else str(name), inner)
        elif isinstance(value, (list, tuple)) and value and isinstance(value[0], dict):
            for number, inner in enumerate(value, 1):
                walk(f"{prefix}.{number}", inner)
        elif value not in (None, "", ()):
            rows.append((prefix, printable(setting(value))))

    walk("", unfolded(asdict(settings)))
    return rows


def _row(path: Path) -> dict[str, Any]:
    try:
        with RunFolder(path) as run:
            history, evaluations, confirmed = run.history(), run.evaluations(), run.confirmation()
            best = best_of(evaluations)
            return {
                "run": printable(run.name),
                "created": run.created,
                "begun": begun(run.created),
                "task": printable(run.spec.task),
                "generations": len(history),
                "mean": history[-1].mean if history else None,
                "best": best.mean if best else None,
                "confirmed": confirmed.mean if confirmed else None,
                "best_error": best.error if best else None,
                "confirmed_error": confirmed.error if confirmed else None,
                "again": _again(run),
                "state": printable(run.state),
                "damaged": False,
            }
    except JournalError as error:
        return {**dict.fromkeys(COLUMNS), "run": printable(path.name), "state": printable(str(error)), "damaged": True}


def _again(run: RunFolder) -> str:
    """The command that goes on with an open run; empty of one that is live, or has ended."""
    return printable(again(run.path)) if run.state == "open" else ""


def begun(created: str) -> str:
    """When a run began, as a person reads it, such as 2026-11-23 17:30 UTC."""
    with suppress(ValueError):
        return f"{datetime.fromisoformat(created).astimezone(UTC):%Y-%m-%d %H:%M} UTC"
    return printable(created)


def _world(run: RunFolder) -> str:
    """The task whose reality gives the scores: of a dream its world model's."""
    task = run.spec.task
    if task == DREAM:
        with suppress(DreamfleetError, OSError):  # its world model may be gone
            task = Bundle.open(run.bundle_path, run.spec.bundle).manifest.task
    return printable(task)


def _facts(run: RunFolder, course: Course, total: Effort) -> Facts:
    settings, best = course.settings, best_of(course.evaluations)
    facts = [
        ("task", settings.task.task),
        ("begun", begun(run.created)),
        ("generations", f"{len(course.history):,}"),
        ("population", f"{settings.population} candidates x {plural(settings.episodes, 'episode')}"),
        ("horizon", f"{settings.task.horizon:,} steps"),
        ("optimiser", f"{optimiser(settings)}, first step size {settings.sigma0:g}"),
        ("seed", str(settings.seed)),
        ("spent", total.told),
        ("hosts", run.classes.told),
        ("best evaluation", NONE if best is None else f"{score(best)}, generation {best.generation}"),
        ("confirmed", NONE if course.confirmed is None else
         f"{score(course.confirmed)} on {course.confirmed.episodes} fresh seeds"),
    ]  # fmt: skip
    return [(name, printable(value)) for name, value in facts]


def _generation(each: StoredGeneration) -> dict[str, Any]:
    return {
        "generation": each.number, "mean": each.mean, "std": each.std, "best": each.best, "worst": each.worst,
        "sigma": each.sigma, "steps": each.steps, "seconds": each.seconds,
    }  # fmt: skip
