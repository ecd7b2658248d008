"""Output of verbs on stdout: aligned tables, or JSON with `--json`. Pages: exit-codes.md."""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Literal

from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.printable import one_line, printable_lines

if TYPE_CHECKING:
    from rich.table import Table

UNLIMITED_WIDTH = 10_000  # columns: a console on which nothing is truncated
PREFERRED_LAST_WIDTH = 24  # columns of the last column of a table; other columns are dropped to make room for them
MIN_LAST_WIDTH = 12


def add_json_flag(parser: argparse.ArgumentParser) -> None:
    """Add the flag `--json`."""
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def print_answer(args: argparse.Namespace, text: str, **facts: object) -> None:
    """Print `text`, or with `--json` the facts as one line of JSON."""
    print(json.dumps(facts, default=str) if args.json else printable_lines(text), flush=True)  # noqa: T201 - a verb's output


def print_next(args: argparse.Namespace, *commands: Sequence[object]) -> None:
    """Print on stderr the verbs to type next, each given as its words; nothing beside JSON or if quiet."""
    if getattr(args, "json", False):
        return
    if logging.getLogger("dreamfleet").level <= logging.INFO:
        trusted = ("--trust", *args.global_config.trust) if "trust" in getattr(args, "given", ()) else ()
        for words in commands:
            print(printable_lines(f"next: {shell_command(*words, *trusted)}"), file=sys.stderr, flush=True)  # noqa: T201


def print_rows(
    rows: Sequence[Mapping[str, object]], right: Collection[str] = (), drop_order: Sequence[str] = ()
) -> None:
    """Print rows that have the same keys, under a heading of the keys. No cell is truncated.

    The columns in `right` are right-aligned. If a terminal is too narrow, columns are left out in `drop_order`, with a
    note below; then the last column wraps. In a pipe, lines have any width.

    >>> print_rows([{"run": "night", "mean": 8.5}, {"run": "day", "mean": 12.25}], right=["mean"])
    run     mean
    night    8.5
    day    12.25
    """
    if not rows:
        return
    if sys.stdout.isatty():
        _print_table(rows, right, drop_order)
        return
    _print_aligned([list(rows[0]), *([_format_cell(value) for value in row.values()] for row in rows)], right)


def _print_aligned(lines: Sequence[Sequence[str]], right: Collection[str]) -> None:
    """Print lines of cells, the first one being the heading, with two spaces between columns."""
    from rich.cells import cell_len

    widths = [max(map(cell_len, column)) for column in zip(*lines, strict=True)]
    is_right = [name in right for name in lines[0]]
    for line in lines:
        gaps = [" " * (width - cell_len(cell)) for cell, width in zip(line, widths, strict=True)]
        cells = [
            gap + cell if at_right else cell + gap for cell, gap, at_right in zip(line, gaps, is_right, strict=True)
        ]
        print("  ".join(cells).rstrip())  # noqa: T201


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
    """The table without the columns `left_out`; `last` is the last column's maximum width."""
    from rich.table import Table
    from rich.text import Text

    names = [name for name in rows[0] if name not in left_out]
    table = Table(box=None, padding=(0, 1), pad_edge=False, header_style="dim")
    for name in names:
        justify: Literal["right", "left"] = "right" if name in right else "left"
        ends = name == names[-1]
        table.add_column(name, justify=justify, no_wrap=not ends, overflow="fold", max_width=last if ends else None)
    for row in rows:
        table.add_row(*(Text(_format_cell(row[name])) for name in names))  # `Text`: untrusted text is no markup
    return table


def _table_width(table: Table) -> int:
    """The width of a table at which nothing is truncated."""
    from rich.console import Console
    from rich.measure import Measurement

    console = Console(width=UNLIMITED_WIDTH)
    return Measurement.get(console, console.options, table).maximum
