"""`dreamfleet runs archive`: out of the way, not out of the world."""

from __future__ import annotations

import argparse

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import JournalError
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_lock import run_lock
from dreamfleet.common.runs.run_paths import ARCHIVE, check_movable, reporting_folder_errors

SUMMARY = "move a run that nobody serves into the archive"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Move the folder."""
    open_run(args.runs_dir, args.run_name).close()
    source, target = args.runs_dir / args.run_name, args.runs_dir / ARCHIVE / args.run_name
    if target.exists():
        raise JournalError(f"{target} exists; rename or delete it first")
    check_movable(source)
    with run_lock(source), reporting_folder_errors(source):
        target.parent.mkdir(exist_ok=True)
        source.rename(target)
    print_answer(args, f"archived as {target}; move it back to use it again", run=args.run_name, archived=target)
    return 0
