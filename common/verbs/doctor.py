"""`dreamfleet doctor`: what is installed, what is missing, and the remedy."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys

SUMMARY = "check this installation: versions, fingerprint, what is missing and the remedy"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--json", action="store_true", help="print the report as JSON")


def run(args: argparse.Namespace) -> int:
    """Print the report; exit 1 if something that any role needs is broken."""
    from rich.console import Console
    from rich.table import Table

    from dreamfleet.common.fingerprint import fingerprint
    from dreamfleet.common.health import examine

    findings = examine()
    broken = [each for each in findings if each.needed and not each.ok]
    if args.json:
        report = {
            "python": platform.python_version(),
            "platform": platform.platform(),
            "cores": os.cpu_count(),
            "fingerprint": fingerprint(),
            "checks": [vars(each) for each in findings],
            "ok": not broken,
        }
        print(json.dumps(report, indent=2))
        return 1 if broken else 0
    console = Console()
    console.print(f"Python {platform.python_version()} at {sys.prefix}, {os.cpu_count()} cores, {platform.platform()}")
    console.print(f"fingerprint: {fingerprint()}", style="dim")
    table = Table(box=None, padding=(0, 2), header_style="dim")
    for column in ("", "check", "found", "for", "remedy"):
        table.add_column(column)
    for each in findings:
        mark = "[green]ok[/]" if each.ok else "[red]missing[/]" if each.needed else "[yellow]absent[/]"
        table.add_row(mark, each.name, each.found, each.role, "" if each.ok else each.remedy)
    console.print(table)
    return 1 if broken else 0
