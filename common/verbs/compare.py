"""`dreamfleet compare`: whether one controller scores better than another."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural
from dreamfleet.common.runs.evaluation_report import EvaluationReport, read_evaluation_report
from dreamfleet.common.runs.paired_difference import PairedDifference
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.score_words import score_word

SUMMARY = "print the paired difference of each report of `evaluate --out` from the first"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("reports", metavar="REPORT", nargs="+", type=Path, help="files of `evaluate --out`, 2 or more")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Print each mean, and its difference from the first on equal seeds."""
    if len(args.reports) < 2:
        raise UsageError("give two reports or more: each is compared with the first")
    (first, base), *others = [(path, read_evaluation_report(path)) for path in args.reports]
    lines, rows = [_line(first, base)], []
    for path, each in others:
        _warn(first, base, path, each)
        found = PairedDifference.between(base.results, each.results)
        lines += [_line(path, each), f"{path} less {first}: {found.description}"]
        rows.append({"report": path, "against": first, **asdict(found), "clear": found.is_significant})
    print_answer(args, "\n".join(lines), differences=rows)
    return 0


def _line(path: Path, found: EvaluationReport) -> str:
    score = format_with_error(found.results.mean, found.results.error)
    failed = f", and {len(found.failed)} failed" if found.failed else ""
    return f"{path}: {found.name}, {score} on {plural(len(found.drives), score_word(found.world))}{failed}"


def _warn(first: Path, base: EvaluationReport, path: Path, other: EvaluationReport) -> None:
    """Note what besides the controllers may cause a difference."""
    for what in ("world", "fingerprint"):
        one, another = getattr(base, what), getattr(other, what)
        if one != another:
            print(f"note: {first} and {path} are of different {what}s: {one!r} and {another!r}", file=sys.stderr)
