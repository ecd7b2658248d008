"""`dreamfleet inspect`: a page about a world model."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from dreamfleet.common.errors import UsageError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.seeds import VALIDATION
from dreamfleet.common.site import offer

SUMMARY = "look into a world model: what it sees, keeps and dreams, as pictures and one page"
EXTRAS = ("worker", "views")
SECTIONS = 10  # at most


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("subject", metavar="BUNDLE|RUN", help="a bundle's file, one that ships, or a run")
    parser.add_argument("--out", type=Path, default=Path("inspection"), help="folder to write (default inspection)")
    parser.add_argument("--data", type=Path, help="the data folder that it was trained in, for the loss curves")
    first = VALIDATION.start
    parser.add_argument("--seed", type=int, default=first, help=f"the track that is driven (default {first})")
    parser.add_argument("--steps", type=int, default=300, help="steps of the drive (default 300)")
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Draw and print where the page lies."""
    if args.steps < 2 or args.seed < 0:
        raise UsageError("--steps must be at least 2 and --seed at least 0")
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.worker.inspection.inspection import find_subject, inspect
    from dreamfleet.worker.inspection.rollout import DriveConfig

    with find_subject(args.subject, args.runs_dir) as subject, progress_bar("inspect", SECTIONS, "sections") as bar:
        page = inspect(subject, args.out, DriveConfig(args.seed, args.steps), args.data, bar.move)
        bar.move(SECTIONS)
    answer(args, str(page), page=page)
    return 0
