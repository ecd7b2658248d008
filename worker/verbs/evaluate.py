"""`dreamfleet evaluate`: a controller on unseen tracks."""

from __future__ import annotations

import argparse
import json
import os
import sys
from typing import TYPE_CHECKING

from dreamfleet.common.errors import UsageError
from dreamfleet.common.seeds import TEST
from dreamfleet.common.site import offer

if TYPE_CHECKING:
    from dreamfleet.common.bundle import Bundle
    from dreamfleet.common.controller import Controller

SUMMARY = "judge a controller on unseen tracks, in gymnasium's own unmodified environment"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--controller", help="a file, a run, or one that ships")
    parser.add_argument("--run", dest="run_name", metavar="RUN", help="judge what this live run reports instead")
    offer(parser, "connect", texts={"connect": "ask the live run here (give --run too where there are several)"})
    parser.add_argument("--episodes", type=int, default=100, help="tracks (default 100)")
    parser.add_argument("--first-seed", type=int, default=TEST.start, help=f"first track's seed (default {TEST.start})")
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default one a core)")
    offer(parser, "runs_dir")
    parser.add_argument("--json", action="store_true", help="print mean, std, scores and seeds as JSON")


def run(args: argparse.Namespace) -> int:
    """Drive and print the scores."""
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.worker.tools.evaluation import Evaluated, evaluate

    if args.episodes < 1 or args.first_seed < 0 or args.jobs < 1:
        raise UsageError("--episodes and --jobs must be at least 1, --first-seed at least 0")
    controller, bundle = _choose(args)
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
        print(
            json.dumps(
                {**report, "task": controller.task, "bundle": bundle.sha256 if bundle else "", "judge": "gymnasium"}
            )
        )
    else:
        low, high = min(done.scores), max(done.scores)
        error = done.std / len(seeds) ** 0.5
        print(
            f"{done.mean:.1f} ± {error:.1f} (standard error) on {len(seeds)} seeds, {low:.0f} to {high:.0f}, "
            f"standard deviation {done.std:.1f}; judged by gymnasium's own environment"
        )
    return 0


def _choose(args: argparse.Namespace) -> tuple[Controller, Bundle | None]:
    """What to judge, and its world model: from here, or from a live run."""
    from dreamfleet.common.client import Client
    from dreamfleet.common.shelf import find_controller
    from dreamfleet.worker.service.bundle_fetch import fetch_for
    from dreamfleet.worker.tools.evaluation import bundle_for

    live = bool(args.run_name) or "connect" in args.given
    if live and not args.controller:
        with Client(args.connect) as client:
            run = args.run_name or client.status().run
            controller = client.controller(run)
            if args.bundle is None:
                return controller, fetch_for(controller, client.session, run)
        return controller, bundle_for(controller, args.bundle)
    if live or not args.controller:
        raise UsageError("give either --controller, or --run (and --connect) to judge what a live run reports")
    controller, beside = find_controller(args.controller, args.runs_dir)
    return controller, bundle_for(controller, args.bundle, beside)
