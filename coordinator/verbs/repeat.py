"""`dreamfleet repeat`: the run again that a controller came from."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from dreamfleet.common.config import add_flags
from dreamfleet.common.keys import check_run_name
from dreamfleet.common.listing import add_json
from dreamfleet.common.site import offer
from dreamfleet.coordinator.config import NetworkConfig

SUMMARY = "begin the run again that a controller came from, by its receipt, and compare what it reports, to the bit"
EXTRAS = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("controller", metavar="CONTROLLER", help="a file, a run, or one that ships; it is only read")
    parser.add_argument("--run", dest="run_name", help="the new run, or one to go on with (default CONTROLLER-again)")
    parser.add_argument("--optimiser", metavar="MODULE:ATTRIBUTE", help="an optimiser of one's own that the run had")
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    offer(parser, "runs_dir")
    add_json(parser)
    add_flags(parser, NetworkConfig)


def run(args: argparse.Namespace) -> int:
    """Serve the run until it has as many generations; exit 1 if it then reports another controller."""
    from dreamfleet.common.shelf import bundle_for, find_controller
    from dreamfleet.coordinator.repetition import Repetition
    from dreamfleet.coordinator.verbs.coordinator import Outcome, request_of, serve_request

    controller, beside = find_controller(args.controller, args.runs_dir)
    again = Repetition.of(controller, bundle_for(controller, args.bundle, beside))
    again.check_optimiser(args.optimiser)
    folder = args.runs_dir / check_run_name(args.run_name or f"{Path(args.controller).stem}-again")
    config, kept = again.plan(folder)
    if again.doubt:
        print(f"note: {again.doubt}", file=sys.stderr)
    request = request_of(args, folder.name, config, again.limits, kept, again.start if config else None)

    def judge() -> Outcome:
        found = again.compare(folder)
        return Outcome(f"; {found.told}", {"same": found.same, "why": found.why}, 0 if found.same else 1)

    return serve_request(args, request, judge=judge)
