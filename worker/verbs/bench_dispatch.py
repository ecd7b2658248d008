"""`dreamfleet bench dispatch`: the coordinator's own speed."""

from __future__ import annotations

import argparse
import json

SUMMARY = "measure dispatch through real Zenoh: 50 ms jobs, null jobs, crowds of workers; peers where installed"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "--workers", type=int, default=0, metavar="N", help="also let N simulated workers join and work"
    )
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def run(args: argparse.Namespace) -> int:
    """Measure."""
    from dreamfleet.worker.bench.dispatch import bench_dispatch

    figures = bench_dispatch(max(0, args.workers))
    if args.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:>22}  {value}")
    return 0
