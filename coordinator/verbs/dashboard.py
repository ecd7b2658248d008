"""`dreamfleet dashboard`: a page about live and past runs."""

from __future__ import annotations

import argparse
import sys

from dreamfleet.common.config import add_flags, load
from dreamfleet.common.site import offer, reached
from dreamfleet.coordinator.dashboard.config import DashboardConfig

SUMMARY = "serve a read-only web page about live runs and those on this disk"
EXTRAS = ("dashboard",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    offer(parser, "connect", "runs_dir")
    parser.add_argument("--run", help="follow this run alone (default: every live one)")
    add_flags(parser, DashboardConfig)


def run(args: argparse.Namespace) -> int:
    """Serve it until Ctrl-C."""
    config = load(DashboardConfig, "dashboard", **args.sources)
    from dreamfleet.coordinator.dashboard.serving import serve
    from dreamfleet.coordinator.dashboard.views import Views
    from dreamfleet.coordinator.dashboard.watching import Watcher

    network = reached(args)
    joined = () if args.site.join is None else ("--join", str(args.site.join))
    views = Views(("--connect", *network.connect, *joined), args.runs_dir, config.views)
    serve(config, Watcher(network, args.run, args.runs_dir), views, args.runs_dir, _tell)
    return 0


def _tell(address: str) -> None:
    print(f"the dashboard is at {address}", file=sys.stderr, flush=True)
