"""`dreamfleet bench env`: how much faster than gymnasium's own, and whether it is the same."""

from __future__ import annotations

import argparse
import json
import sys

SUMMARY = "measure the environment against gymnasium's own; --exact proves the two equal over whole episodes"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--bundle", default="tiny", help="the world model of the fitness step (default tiny)")
    parser.add_argument("--episodes", type=int, default=3, help="whole episodes of each kind (default 3)")
    parser.add_argument("--exact", action="store_true", help="compare instead of measuring: about ten minutes")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def run(args: argparse.Namespace) -> int:
    """Measure on one thread, or compare; exit 1 if anything differs."""
    from multiprocessing import get_context

    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.host.resource_limits import clear_library_settings, pin_thread_pools

    bundle = find_bundle(args.bundle)
    clear_library_settings()
    pin_thread_pools()
    if args.exact:
        return _compare(bundle, args.json)
    from dreamfleet.worker.bench.environment import bench_env

    # A child, for numpy's library reads its thread count once, as it loads, and the command line has loaded it.
    with get_context("spawn").Pool(1) as pool:
        figures = pool.apply(bench_env, (bundle, max(1, args.episodes)))
    if args.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:>22}  {value}")
    return 0 if figures["exact"] else 1


def _compare(bundle: object, as_json: bool) -> int:
    from dreamfleet.worker.bench.environment import check_exact

    differences = 0
    done = []
    for what, difference in check_exact(bundle):  # type: ignore[arg-type]
        differences += difference is not None
        done.append(what)
        outcome = "the same" if difference is None else f"DIFFERS at step {difference.step}: {difference.what}"
        print(f"{what}: {outcome}", file=sys.stderr)
    if as_json:
        print(json.dumps({"exact": not differences, "compared": done, "differences": differences}))
    return 1 if differences else 0
