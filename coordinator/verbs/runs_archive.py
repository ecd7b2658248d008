"""`dreamfleet runs archive`: out of the way, not out of the world."""

from __future__ import annotations

import argparse

from dreamfleet.common.errors import JournalError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.runs import ARCHIVE, check_single, open_run, run_lock, translated
from dreamfleet.common.site import offer

SUMMARY = "move a run that nobody serves into the archive"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Move the folder."""
    open_run(args.runs_dir, args.run_name).close()
    source, target = args.runs_dir / args.run_name, args.runs_dir / ARCHIVE / args.run_name
    if target.exists():
        raise JournalError(f"{target} exists; rename or delete it first")
    check_single(source)
    with run_lock(source), translated(source):
        target.parent.mkdir(exist_ok=True)
        source.rename(target)
    answer(args, f"archived as {target}; move it back to use it again", run=args.run_name, archived=target)
    return 0
