"""`dreamfleet bench dream`: how near a dreamed step is to what the core can do."""

from __future__ import annotations

import argparse
import json

SUMMARY = "measure dreamed steps a second, against its matrix products alone and against torch"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--bundle", default="tiny", help="the world model (default tiny)")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def run(args: argparse.Namespace) -> int:
    """Measure on one thread and print."""
    from multiprocessing import get_context

    from common.bundle import find_bundle
    from common.threads import pin_thread_pools
    from worker.bench.dream import bench_dream

    bundle = find_bundle(args.bundle)
    pin_thread_pools()
    # A child, for numpy's library reads its thread count once, as it loads, and the command line has loaded it.
    with get_context("spawn").Pool(1) as pool:
        figures = pool.apply(bench_dream, (bundle,))
    if args.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:>22}  {value}")
    return 0
