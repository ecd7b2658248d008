"""What a verb answers: tables for people, tab-separated lines for pipes, JSON where it is asked for."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

from dreamfleet.common.printable import one_line, printable_lines

if TYPE_CHECKING:
    from rich.table import Table

WIDEST = 10_000  # columns: where nothing is cut any more
PREFERRED_LAST_WIDTH, MIN_LAST_WIDTH = (
    24,
    12,
)  # columns that a last one of long texts has before others are left out for it, and at least


def add_json_flag(parser: argparse.ArgumentParser) -> None:
    """The flag `--json` of a verb that answers."""
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def print_answer(args: argparse.Namespace, text: str, **facts: object) -> None:
    """Print `text`, or with `--json` the facts as one line."""
    print(json.dumps(facts, default=str) if args.json else printable_lines(text), flush=True)  # noqa: T201 - what a verb answers


def print_rows(
    rows: Sequence[Mapping[str, object]], right: Collection[str] = (), drop_order: Sequence[str] = ()
) -> None:
    """Print rows of the same keys under their names: nothing is cut, in a terminal or in a pipe.

    In a terminal a table, the columns in `right` aligned so. Where it is too narrow the columns in `drop_order` are
    left out one by one, which is said below; then texts of the last column go on in further lines. In a pipe,
    tab-separated lines.
    """
    if not rows:
        return
    if sys.stdout.isatty():
        _print_table(rows, right, drop_order)
        return
    for line in (list(rows[0]), *(row.values() for row in rows)):
        print("\t".join(_format_cell(value) for value in line))  # noqa: T201


def _format_cell(value: object) -> str:
    return "-" if value is None else one_line(str(value))


def _print_table(rows: Sequence[Mapping[str, object]], right: Collection[str], drop_order: Sequence[str]) -> None:
    from rich.console import Console
    from rich.text import Text

    console, left_out = Console(), list[str]()
    for name in drop_order:
        if _table_width(_build_table(rows, right, left_out, last=PREFERRED_LAST_WIDTH)) > console.width:
            left_out.append(name)
    table = _build_table(rows, right, left_out)
    Console(width=max(console.width, _table_width(_build_table(rows, right, left_out, last=MIN_LAST_WIDTH)))).print(
        table
    )
    if left_out:
        console.print(Text(f"no room here for {', '.join(left_out)}", style="dim"))


def _build_table(
    rows: Sequence[Mapping[str, object]], right: Collection[str], left_out: Collection[str], last: int | None = None
) -> Table:
    """All but some columns; `last` is the most that the last one takes."""
    from rich.table import Table
    from rich.text import Text

    names = [name for name in rows[0] if name not in left_out]
    table = Table(box=None, padding=(0, 1), pad_edge=False, header_style="dim")
    for name in names:
        justify: Literal["right", "left"] = "right" if name in right else "left"
        ends = name == names[-1]
        most = last if ends else None
        table.add_column(name, justify=justify, no_wrap=not ends, overflow="fold", max_width=most)
    for row in rows:
        table.add_row(*(Text(_format_cell(row[name])) for name in names))  # no markup: they may come from outside
    return table


def _table_width(table: Table) -> int:
    """Columns that it takes."""
    from rich.console import Console
    from rich.measure import Measurement

    console = Console(width=WIDEST)
    return Measurement.get(console, console.options, table).maximum
