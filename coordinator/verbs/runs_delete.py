"""`dreamfleet runs delete`: a run and everything in its folder."""

from __future__ import annotations

import argparse
import shutil
import sys

from dreamfleet.common.errors import UsageError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.runs import check_single, open_run, run_lock, translated
from dreamfleet.common.site import offer

SUMMARY = "delete a run that nobody serves, with its journal, controller and videos"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    offer(parser, "runs_dir")
    add_json(parser)
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
            answer(args, "kept", run=args.run_name, deleted=None)
            return 1
    folder = args.runs_dir / args.run_name
    check_single(folder)
    with run_lock(folder), translated(folder):
        shutil.rmtree(folder)
    answer(args, f"deleted {folder}", run=args.run_name, deleted=folder)
    return 0
