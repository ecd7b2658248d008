"""`dreamfleet runs delete`: a run and everything in its folder."""

from __future__ import annotations

import argparse
import shutil
import sys

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.run_lock import run_lock
from dreamfleet.common.runs.run_paths import check_movable, reporting_folder_errors

SUMMARY = "delete a run that nobody serves, with its journal, controller and videos"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)
    parser.add_argument("--yes", action="store_true", help="do not ask")


def run(args: argparse.Namespace) -> int:
    """Ask, then delete."""
    with open_run(args.runs_dir, args.run_name) as stored:
        generations = len(stored.history())
    if not args.yes:
        if not sys.stdin.isatty():
            raise UsageError("nobody is there to confirm: give --yes")
        said = input(f"delete run {args.run_name} with its {generations} generations? [y/N] ")
        if said.strip().lower() not in ("y", "yes"):
            print_answer(args, "kept", run=args.run_name, deleted=None)
            return 1
    folder = args.runs_dir / args.run_name
    check_movable(folder)
    with run_lock(folder), reporting_folder_errors(folder):
        shutil.rmtree(folder)
    print_answer(args, f"deleted {folder}", run=args.run_name, deleted=folder)
    return 0
