"""`dreamfleet runs list`: the runs on this disk."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_rows
from dreamfleet.common.errors import JournalError
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import ARCHIVE, run_paths

SUMMARY = "list the runs on this disk"
EXTRAS = ()
LEAST_FIRST = ("created", "classes", "task", "mean", "evaluated")  # what a narrow terminal does without


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_global_flags(parser, "runs_dir")
    parser.add_argument("--archived", action="store_true", help="list the archived ones instead")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Print a line a run; a damaged journal is a line too."""
    runs_dir = args.runs_dir / ARCHIVE if args.archived else args.runs_dir
    rows = [_run_row(path) for path in run_paths(runs_dir)]
    if args.json:
        print(json.dumps(rows, indent=2))
        return 0
    if not rows:
        print(f"no runs in {runs_dir}; start one with: dreamfleet coordinator --run NAME", file=sys.stderr)
        return 0
    print_rows(rows, right=("generations", "mean", "evaluated", "confirmed", "classes"), drop_order=LEAST_FIRST)
    return 0


def _run_row(path: Path) -> dict[str, object]:
    try:
        with RunFolder(path) as run:
            history, evaluations, confirmed = run.history(), run.evaluations(), run.confirmation()
            return {
                "run": run.name,
                "created": run.created,
                "task": run.spec.task,
                "generations": len(history),
                "mean": round(history[-1].mean, 1) if history else None,
                "evaluated": round(evaluations[-1].mean, 1) if evaluations else None,
                "confirmed": round(confirmed.mean, 1) if confirmed else None,
                "classes": run.classes.total,
                "state": run.state,
            }
    except JournalError as error:
        return {"run": path.name, "created": None, "task": None, "generations": None, "mean": None,
                "evaluated": None, "confirmed": None, "classes": None, "state": str(error)}  # fmt: skip
