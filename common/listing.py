"""What a verb answers: tables for people, tab-separated lines for pipes, JSON where it is asked for."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Collection, Mapping, Sequence

from dreamfleet.common.printable import one_line, printable_lines

WIDEST = 10_000  # columns: where nothing is cut any more


def add_json(parser: argparse.ArgumentParser) -> None:
    """The flag `--json` of a verb that answers."""
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def answer(args: argparse.Namespace, text: str, **facts: object) -> None:
    """Print `text`, or with `--json` the facts as one line."""
    print(json.dumps(facts, default=str) if args.json else printable_lines(text), flush=True)  # noqa: T201 - what a verb answers


def print_rows(rows: Sequence[Mapping[str, object]], right: Collection[str] = ()) -> None:
    """Print rows of the same keys under their names: nothing is cut, in a terminal or in a pipe.

    In a terminal a table, the columns in `right` aligned so; elsewhere tab-separated lines.
    """
    if not rows:
        return
    if sys.stdout.isatty():
        _print_table(rows, right)
        return
    for line in (list(rows[0]), *(row.values() for row in rows)):
        print("\t".join(_cell(value) for value in line))  # noqa: T201


def _cell(value: object) -> str:
    return "-" if value is None else one_line(str(value))


def _print_table(rows: Sequence[Mapping[str, object]], right: Collection[str]) -> None:
    from rich.console import Console
    from rich.measure import Measurement
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, padding=(0, 1), pad_edge=False, header_style="dim")
    for name in rows[0]:
        table.add_column(name, justify="right" if name in right else "left", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(_cell(value)) for value in row.values()))  # no markup: they may come from outside
    console = Console()
    needed = Measurement.get(console, console.options.update(max_width=WIDEST), table).maximum
    Console(width=max(console.width, needed)).print(table)
