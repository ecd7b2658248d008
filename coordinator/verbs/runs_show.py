"""`dreamfleet runs show`: one run from its journal."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from dreamfleet.common.runs import default_runs_dir, open_run

SUMMARY = "show one run from its journal: settings, history, evaluations"
EXTRAS = ()
SHOWN = 20


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--runs-dir", type=Path, default=default_runs_dir(), help="where runs live (default runs)")
    parser.add_argument("--json", action="store_true", help="print everything as JSON")


def run(args: argparse.Namespace) -> int:
    """Print the run."""
    from rich.console import Console
    from rich.table import Table

    with open_run(args.runs_dir, args.run_name) as stored:
        settings, history, evaluations = stored.settings, stored.history(), stored.evaluations()
        facts = {"run": stored.name, "run_uid": stored.uid, "created": stored.created, "ended": stored.ended,
                 "fingerprint": stored.fingerprint}  # fmt: skip
    if args.json:
        rows = {"history": [asdict(each) for each in history], "evaluations": [asdict(each) for each in evaluations]}
        print(json.dumps({**facts, "settings": asdict(settings), **rows}, indent=2))
        return 0
    console = Console()
    for name, value in {**facts, **asdict(settings.task), **asdict(settings)}.items():
        if not isinstance(value, dict):
            console.print(f"[dim]{name:>20}[/]  {value}", highlight=False)
    table = Table(box=None, padding=(0, 2), header_style="dim")
    for column in ("generation", "mean", "std", "best", "worst", "sigma", "steps", "seconds", "evaluated"):
        table.add_column(column, justify="right")
    judged = {each.generation: each.mean for each in evaluations}
    for each in history[-SHOWN:]:
        evaluated = f"{judged[each.number]:.1f}" if each.number in judged else ""
        table.add_row(
            str(each.number), f"{each.mean:.1f}", f"{each.std:.1f}", f"{each.best:.1f}", f"{each.worst:.1f}",
            f"{each.sigma:.4f}", str(each.steps), f"{each.seconds:.1f}", evaluated,
        )  # fmt: skip
    if len(history) > SHOWN:
        console.print(f"the last {SHOWN} of {len(history)} generations; --json has all", style="dim")
    console.print(table)
    return 0
