"""`dreamfleet runs show`: one run from its journal."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from typing import Any

from dreamfleet.common.eta import duration
from dreamfleet.common.listing import add_json, print_rows
from dreamfleet.common.printable import setting
from dreamfleet.common.runs import open_run
from dreamfleet.common.site import offer
from dreamfleet.common.stages import begun_stages, stages_told
from dreamfleet.common.stored import RunSettings, StoredGeneration, best_of, told

SUMMARY = "show one run from its journal: settings, history, evaluations"
EXTRAS = ()
SHOWN = 20


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the run."""
    with open_run(args.runs_dir, args.run_name) as stored, stored.at_one_moment():
        settings, history, evaluations = stored.settings, stored.history(), stored.evaluations()
        confirmed, lasted = stored.confirmation(), stored.lasted
        facts = {"run": stored.name, "run_uid": stored.uid, "created": stored.created, "ended": stored.ended,
                 "ended_at": stored.ended_at, "lasted_seconds": lasted, "fingerprint": stored.fingerprint}  # fmt: skip
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
    if lasted is not None:
        facts["ended_at"] = f"{facts['ended_at']}, {duration(lasted)} after it began"
    facts["hosts"] = classes.told
    facts |= {f"class {name}": hosts for name, hosts in classes.rows}
    facts["reported"] = told(confirmed or best_of(evaluations))
    facts |= {"stage": f"{len(begun)} of {len(settings.stages)}"} if begun else {}
    shown_settings = {**_flat(settings), **stages_told(settings, begun)}
    print_rows([{"": name, "value": value} for name, value in {**facts, **shown_settings}.items()])
    print()
    shown = history[-SHOWN:] if sys.stdout.isatty() else history
    judged = {each.generation: each.mean for each in evaluations}
    lines = [_row(each, judged.get(each.number)) for each in shown]
    if len(shown) < len(history):
        print(f"the last {SHOWN} of {len(history)} generations; --json has all")
    print_rows(lines, right=tuple(lines[0]) if lines else (), least_first=("seconds", "worst", "steps", "std", "sigma"))
    return 0


def _flat(settings: RunSettings) -> dict[str, object]:
    """The settings with the task's and the controller's among them, but for the stages."""
    flat: dict[str, object] = {}
    plain = asdict(settings)
    del plain["stages"]
    for name, value in plain.items():
        flat |= {name: value} if not isinstance(value, dict) else _within(name, value)
    return {name: None if value in (None, "", ()) else setting(value) for name, value in flat.items()}


def _within(name: str, parts: dict[str, object]) -> dict[str, object]:
    return {part if part == name else f"{name}.{part}": value for part, value in parts.items() if value is not None}


def _row(each: StoredGeneration, evaluated: float | None) -> dict[str, object]:
    return {
        "generation": each.number, "mean": f"{each.mean:.1f}", "std": f"{each.std:.1f}", "best": f"{each.best:.1f}",
        "worst": f"{each.worst:.1f}", "sigma": f"{each.sigma:.4f}", "steps": each.steps,
        "seconds": f"{each.seconds:.1f}", "evaluated": "" if evaluated is None else f"{evaluated:.1f}",
    }  # fmt: skip
