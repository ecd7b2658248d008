"""`dreamfleet runs delete`: a run and everything in its folder."""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path

from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs import default_runs_dir, open_run, run_lock

SUMMARY = "delete a run that nobody serves, with its journal, controller and videos"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--runs-dir", type=Path, default=default_runs_dir(), help="where runs live (default runs)")
    parser.add_argument("--yes", action="store_true", help="do not ask")


def run(args: argparse.Namespace) -> int:
    """Ask, then delete."""
    with open_run(args.runs_dir, args.run_name) as stored:
        generations = len(stored.history())
    if not args.yes:
        if not sys.stdin.isatty():
            raise UsageError("nobody is there to confirm: give --yes")
        answer = input(f"delete run {args.run_name} with its {generations} generations? [y/N] ")
        if answer.strip().lower() not in ("y", "yes"):
            print("kept")
            return 1
    folder = args.runs_dir / args.run_name
    with run_lock(folder):
        shutil.rmtree(folder)
    print(f"deleted {folder}")
    return 0
