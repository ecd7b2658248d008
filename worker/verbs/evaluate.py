"""`dreamfleet evaluate`: a controller on unseen tracks."""

from __future__ import annotations

import argparse
import json
import os
import sys

from dreamfleet.common.errors import UsageError
from dreamfleet.common.seeds import TEST
from dreamfleet.common.site import offer

SUMMARY = "judge a controller on unseen tracks, in gymnasium's own unmodified environment"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--controller", required=True, help="a file, a run that has ended, or one that ships")
    parser.add_argument("--episodes", type=int, default=100, help="tracks (default 100)")
    parser.add_argument("--first-seed", type=int, default=TEST.start, help=f"first track's seed (default {TEST.start})")
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default one a core)")
    offer(parser, "runs_dir")
    parser.add_argument("--json", action="store_true", help="print mean, std, scores and seeds as JSON")


def run(args: argparse.Namespace) -> int:
    """Drive and print the scores."""
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.common.shelf import find_controller
    from dreamfleet.worker.tools.evaluation import Evaluated, bundle_for, evaluate

    if args.episodes < 1 or args.first_seed < 0 or args.jobs < 1:
        raise UsageError("--episodes and --jobs must be at least 1, --first-seed at least 0")
    controller, beside = find_controller(args.controller, args.runs_dir)
    bundle = bundle_for(controller, args.bundle, beside)
    seeds = tuple(range(args.first_seed, args.first_seed + args.episodes))
    if seeds[0] not in TEST or seeds[-1] not in TEST:
        print(f"note: test tracks are {TEST.start} to {TEST.stop - 1}; some of these are not", file=sys.stderr)
    scores: dict[int, float] = {}
    with progress_bar("evaluate", len(seeds), "tracks") as bar:
        for seed, score in evaluate(controller, bundle, seeds, args.jobs):
            scores[seed] = score
            bar.move(len(scores), f"mean {sum(scores.values()) / len(scores):.1f}")
    done = Evaluated(seeds, tuple(scores[seed] for seed in seeds))
    if args.json:
        report = {"mean": done.mean, "std": done.std, "scores": done.scores, "seeds": done.seeds}
        print(json.dumps({**report, "task": controller.task, "bundle": controller.bundle, "judge": "gymnasium"}))
    else:
        low, high = min(done.scores), max(done.scores)
        print(f"{done.mean:.1f} ± {done.std:.1f} on {len(seeds)} tracks ({low:.0f} to {high:.0f}), judged by gymnasium")
    return 0
