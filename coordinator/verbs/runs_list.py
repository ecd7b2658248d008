"""`dreamfleet runs list`: the runs on this disk."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from dreamfleet.common.errors import JournalError
from dreamfleet.common.runs import ARCHIVE, RunFolder, default_runs_dir, run_paths

SUMMARY = "list the runs on this disk"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--runs-dir", type=Path, default=default_runs_dir(), help="where runs live (default runs)")
    parser.add_argument("--archived", action="store_true", help="list the archived ones instead")
    parser.add_argument("--json", action="store_true", help="print them as JSON")


def run(args: argparse.Namespace) -> int:
    """Print a line a run; a damaged journal is a line too."""
    from rich.console import Console
    from rich.table import Table

    runs_dir = args.runs_dir / ARCHIVE if args.archived else args.runs_dir
    rows = [_row(path) for path in run_paths(runs_dir)]
    if args.json:
        print(json.dumps(rows, indent=2))
        return 0
    if not rows:
        print(f"no runs in {runs_dir}; start one with: dreamfleet coordinator --run NAME")
        return 0
    table = Table(box=None, padding=(0, 2), header_style="dim")
    for column in ("run", "created", "task", "generations", "last mean", "evaluated", "state"):
        table.add_column(column, justify="right" if column in ("generations", "last mean", "evaluated") else "left")
    for row in rows:
        table.add_row(*(str(value) for value in row.values()))
    Console().print(table)
    return 0


def _row(path: Path) -> dict[str, object]:
    try:
        with RunFolder(path) as run:
            history, evaluations = run.history(), run.evaluations()
            return {
                "run": run.name,
                "created": run.created,
                "task": run.spec.task,
                "generations": len(history),
                "mean": round(history[-1].mean, 1) if history else "-",
                "evaluated": round(evaluations[-1].mean, 1) if evaluations else "-",
                "state": f"ended: {run.ended}" if run.ended else "open",
            }
    except JournalError as error:
        return {"run": path.name, "created": "-", "task": "-", "generations": "-", "mean": "-", "evaluated": "-",
                "state": str(error)}  # fmt: skip
