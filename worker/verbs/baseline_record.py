"""`dreamfleet baseline record`: a baseline's drive as a video."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.seeds import TEST

SUMMARY = "record a baseline's drive as an mp4"
EXTRAS = ("worker", "views")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.baselines.names import NAMES

    parser.add_argument("agent", choices=NAMES, help="who drives")
    parser.add_argument("--data", type=Path, help="of drqn: the folder of its training")
    parser.add_argument("--seed", type=int, default=TEST.start, help=f"the track (default {TEST.start})")
    parser.add_argument("--steps", type=int, default=1000, help="steps at most (default 1000)")
    parser.add_argument("--out", type=Path, default=Path("drive.mp4"), help="the video to write (default drive.mp4)")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Record and print the score."""
    if args.steps < 1 or args.seed < 0:
        raise UsageError("--steps must be at least 1 and --seed at least 0")
    if args.out.suffix != ".mp4":
        raise UsageError(f"--out {args.out}: give a name that ends in .mp4")
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.common.stopping import heeding_signals
    from dreamfleet.worker.baselines.agents import find_agent
    from dreamfleet.worker.baselines.recording import record_agent

    agent = find_agent(args.agent, args.data)
    with progress_bar("record", args.steps, "steps") as bar, heeding_signals() as stop:
        score = record_agent(agent, args.seed, args.steps, args.out, bar.move, stop)
        if stop():
            raise StoppedError(
                f"stopped: {args.out} shows the beginning of the drive on track {args.seed}, with a score of "
                f"{score:.1f}; the same command records the whole drive"
            )
    answer(args, f"{args.out}: score {score:.1f} on track {args.seed}", video=args.out, score=score, seed=args.seed)
    return 0
