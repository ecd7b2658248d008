"""`dreamfleet runs receipt`: what a paper cites of a run."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag
from dreamfleet.common.files.atomic_write import check_output_path, open_output
from dreamfleet.common.printable import printable_lines
from dreamfleet.common.runs.run_folder import open_run

SUMMARY = (
    "tell what a paper cites of a run: seeds, hashes, versions, fingerprint, score, and the commands that check it"
)
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--out", type=Path, help="write it there instead of printing it")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Print the receipt of what the run reports, as Markdown or as JSON."""
    from dreamfleet.coordinator.analysis.citation import citation_facts, format_markdown

    if args.out is not None:
        check_output_path(args.out)
    with open_run(args.runs_dir, args.run_name) as stored, stored.read_transaction():
        text = (
            json.dumps(citation_facts(stored), default=str) if args.json else printable_lines(format_markdown(stored))
        )
    if args.out is None:
        print(text)
        return 0
    with open_output(args.out) as file:
        file.write(f"{text}\n".encode())
    print(args.out)
    return 0
