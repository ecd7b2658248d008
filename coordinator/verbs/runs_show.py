"""`dreamfleet runs show`: one run from its journal."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from typing import Any

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_rows
from dreamfleet.common.monitoring.eta import format_duration
from dreamfleet.common.printable import format_setting
from dreamfleet.common.runs.records import RunSettings, StoredGeneration, best_evaluation, describe_score
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.stages import begun_stages, describe_stages

SUMMARY = "show one run from its journal: settings, history, evaluations"
EXTRAS = ()
LAST_GENERATIONS = 20


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Print the run."""
    with open_run(args.runs_dir, args.run_name) as stored, stored.read_transaction():
        settings, history, evaluations = stored.settings, stored.history(), stored.evaluations()
        confirmed, duration_seconds = stored.confirmation(), stored.duration_seconds
        facts = {
            "run": stored.name,
            "run_uid": stored.uid,
            "created": stored.created,
            "ended": stored.ended,
            "ended_at": stored.ended_at,
            "lasted_seconds": duration_seconds,
            "fingerprint": stored.fingerprint,
        }
        classes = stored.classes
    begun = begun_stages(settings, history, evaluations) if settings.stages else ()
    if args.json:
        rows: dict[str, Any] = {"history": [asdict(each) for each in history]}
        rows["evaluations"] = [asdict(each) for each in evaluations]
        rows["stages"] = [{"number": each.stage.number, "since": each.since, "after": each.why} for each in begun]
        reported = None if confirmed is None else {**asdict(confirmed), "error": confirmed.error}
        rows["classes"] = asdict(classes)
        print(json.dumps({**facts, "settings": asdict(settings), "confirmed": reported, **rows}, indent=2))
        return 0
    del facts["lasted_seconds"]
    if duration_seconds is not None:
        facts["ended_at"] = f"{facts['ended_at']}, {format_duration(duration_seconds)} after it began"
    facts["hosts"] = classes.description
    facts |= {f"class {name}": hosts for name, hosts in classes.rows}
    facts["reported"] = describe_score(confirmed or best_evaluation(evaluations))
    facts |= {"stage": f"{len(begun)} of {len(settings.stages)}"} if begun else {}
    shown_settings = {**_flatten_settings(settings), **describe_stages(settings, begun)}
    print_rows([{"": name, "value": value} for name, value in {**facts, **shown_settings}.items()])
    print()
    shown = history[-LAST_GENERATIONS:] if sys.stdout.isatty() else history
    judged = {each.generation: each.mean for each in evaluations}
    lines = [_generation_row(each, judged.get(each.number)) for each in shown]
    if len(shown) < len(history):
        print(f"the last {LAST_GENERATIONS} of {len(history)} generations; --json has all")
    print_rows(lines, right=tuple(lines[0]) if lines else (), drop_order=("seconds", "worst", "steps", "std", "sigma"))
    return 0


def _flatten_settings(settings: RunSettings) -> dict[str, object]:
    """The settings with the task's and the controller's among them, but for the stages."""
    flat: dict[str, object] = {}
    plain = asdict(settings)
    del plain["stages"]
    for name, value in plain.items():
        flat |= {name: value} if not isinstance(value, dict) else _prefix_names(name, value)
    return {name: None if value in (None, "", ()) else format_setting(value) for name, value in flat.items()}


def _prefix_names(name: str, parts: dict[str, object]) -> dict[str, object]:
    return {part if part == name else f"{name}.{part}": value for part, value in parts.items() if value is not None}


def _generation_row(each: StoredGeneration, evaluated: float | None) -> dict[str, object]:
    return {
        "generation": each.number, "mean": f"{each.mean:.1f}", "std": f"{each.std:.1f}", "best": f"{each.best:.1f}",
        "worst": f"{each.worst:.1f}", "sigma": f"{each.sigma:.4f}", "steps": each.steps,
        "seconds": f"{each.seconds:.1f}", "evaluated": "" if evaluated is None else f"{evaluated:.1f}",
    }  # fmt: skip
