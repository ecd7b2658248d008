"""`dreamfleet runs archive`: out of the way, not out of the world."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.errors import JournalError
from dreamfleet.common.runs import ARCHIVE, default_runs_dir, open_run, run_lock

SUMMARY = "move a run that nobody serves into the archive"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("run_name", metavar="RUN", help="name of the run")
    parser.add_argument("--runs-dir", type=Path, default=default_runs_dir(), help="where runs live (default runs)")


def run(args: argparse.Namespace) -> int:
    """Move the folder."""
    open_run(args.runs_dir, args.run_name).close()
    source, target = args.runs_dir / args.run_name, args.runs_dir / ARCHIVE / args.run_name
    if target.exists():
        raise JournalError(f"{target} exists; rename or delete it first")
    with run_lock(source):
        target.parent.mkdir(exist_ok=True)
        source.rename(target)
    print(f"archived as {target}; move it back to use it again")
    return 0
