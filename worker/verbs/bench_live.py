"""`dreamfleet bench live`: what the live view costs a slot, watched and unwatched."""

from __future__ import annotations

import argparse
import json

SUMMARY = "measure what the live view costs a slot: while nobody watches, and while somebody does"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--bundle", default="tiny", help="the world model (default tiny)")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def run(args: argparse.Namespace) -> int:
    """Measure, and print a line a task."""
    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.host.resource_limits import pin_thread_pools

    pin_thread_pools()
    from dreamfleet.worker.bench.live import bench_live

    figures = bench_live(find_bundle(args.bundle))
    if args.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:>22}  {value}")
    return 0
