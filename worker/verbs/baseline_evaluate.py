"""`dreamfleet baseline evaluate`: a baseline on unseen tracks."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path, open_output
from dreamfleet.common.host.resource_limits import pin_thread_pools, usable_cores
from dreamfleet.common.runs.seeds import TEST, VALIDATION

SUMMARY = "judge a baseline on unseen tracks as controllers are judged, in gymnasium's own unmodified environment"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.baselines.presets import NAMES

    parser.add_argument("agent", choices=NAMES, help="who drives")
    parser.add_argument("--data", type=Path, help="of drqn: the folder of its training")
    parser.add_argument("--episodes", type=int, default=100, help="tracks (default 100)")
    parser.add_argument(
        "--first-seed", type=int, default=TEST.start,
        help=f"first track's seed: test tracks from {TEST.start} (default), validation tracks from {VALIDATION.start}",
    )  # fmt: skip
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="processes (default one a core)")
    parser.add_argument("--json", action="store_true", help="print every figure and drive as JSON")
    parser.add_argument("--out", type=Path, help="write the same JSON here too, for `compare`")


def run(args: argparse.Namespace) -> int:
    """Drive and print the scores."""
    pin_thread_pools()  # of NumPy and torch, which are not loaded yet
    from dreamfleet.common.runs.evaluation_report import check_seed_range

    if args.episodes < 1 or args.first_seed < 0 or args.jobs < 1:
        raise UsageError("--episodes and --jobs must be at least 1, --first-seed at least 0")
    check_seed_range(args.first_seed, args.episodes)
    if args.out:
        check_output_path(args.out)
    seeds = tuple(range(args.first_seed, args.first_seed + args.episodes))
    if not any(seeds[0] in each and seeds[-1] in each for each in (TEST, VALIDATION)):
        print("note: some of these tracks are neither test nor validation tracks", file=sys.stderr)
    from dreamfleet.worker.baselines.agents import find_baseline
    from dreamfleet.worker.verbs.evaluate import judge

    name = args.agent if args.data is None else f"{args.agent} {args.data}"
    judgement = judge(name, find_baseline(args.agent, args.data), seeds, args.jobs)
    print(judgement.to_json() if args.json else judgement.description, flush=True)
    if args.out:
        with open_output(args.out) as file:
            file.write(f"{judgement.to_json()}\n".encode())
    return 0
