"""`dreamfleet record`: a drive as a video."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.seeds import TEST
from dreamfleet.common.site import offer

SUMMARY = "record a drive as an mp4: the track, what the model sees, what it decodes, what it dreams"
EXTRAS = ("worker", "views")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--controller", required=True, help="a file, a run, or one that ships")
    parser.add_argument("--seed", type=int, default=TEST.start, help=f"the track (default {TEST.start})")
    parser.add_argument("--steps", type=int, default=1000, help="steps at most (default 1000)")
    parser.add_argument("--out", type=Path, default=Path("drive.mp4"), help="the video to write (default drive.mp4)")
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    parser.add_argument("--temperature", type=float, default=1.0, help="of the dream beside the drive (default 1.0)")
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Record and print the score."""
    if args.steps < 1 or args.seed < 0:
        raise UsageError("--steps must be at least 1 and --seed at least 0")
    if args.out.suffix != ".mp4":
        raise UsageError(f"--out {args.out}: give a name that ends in .mp4")
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.common.shelf import bundle_for, find_controller
    from dreamfleet.common.stopping import heeding_signals
    from dreamfleet.worker.dream.daydream import DaydreamConfig
    from dreamfleet.worker.tools.recording import record

    daydream = DaydreamConfig(args.temperature, seed=args.seed)
    controller, beside = find_controller(args.controller, args.runs_dir)
    bundle = bundle_for(controller, args.bundle, beside)
    driven = 0

    def move(done: int) -> None:
        nonlocal driven
        driven = done
        bar.move(done)

    with progress_bar("record", args.steps, "steps") as bar, heeding_signals() as stop:
        score = record(controller, bundle, args.seed, args.steps, args.out, daydream, move, stop)
        if stop():
            raise StoppedError(
                f"stopped: {args.out} shows the first {driven} steps on track {args.seed}, with a score of "
                f"{score:.1f}; the same command records the whole drive"
            )
    answer(args, f"{args.out}: score {score:.1f} on track {args.seed}", video=args.out, score=score, seed=args.seed)
    return 0
