"""`dreamfleet runs receipt`: what a paper cites of a run."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from dreamfleet.common.listing import add_json
from dreamfleet.common.printable import printable_lines
from dreamfleet.common.runs import open_run
from dreamfleet.common.saving import check_out, saving
from dreamfleet.common.site import offer

SUMMARY = (
    "tell what a paper cites of a run: seeds, hashes, versions, fingerprint, score, and the commands that check it"
)
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--out", type=Path, help="write it there instead of printing it")
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the receipt of what the run reports, as Markdown or as JSON."""
    from dreamfleet.coordinator.citation import facts, markdown

    if args.out is not None:
        check_out(args.out)
    with open_run(args.runs_dir, args.run_name) as stored, stored.at_one_moment():
        text = json.dumps(facts(stored), default=str) if args.json else printable_lines(markdown(stored))
    if args.out is None:
        print(text)
        return 0
    with saving(args.out) as file:
        file.write(f"{text}\n".encode())
    print(args.out)
    return 0
