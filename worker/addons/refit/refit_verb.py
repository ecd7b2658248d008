"""`dreamfleet lab refit`: a controller for another world model."""

import argparse
from pathlib import Path

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.worker.addons.refit.stages import DRIVES, RefitRequest, refit_controller

SUMMARY = "fit a controller to another world model, so that it acts there as before, by regression on recorded drives"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("controller", metavar="CONTROLLER", help="a file, a run, or one that ships")
    parser.add_argument("--to", required=True, metavar="BUNDLE", help="the world model to fit it to")
    parser.add_argument("--data", type=Path, required=True, help="folder of the drives that both world models encode")
    parser.add_argument("--out", type=Path, required=True, help="the controller to write, NAME.npz")
    parser.add_argument("--bundle", help="the world model that it was evolved with, if it is not found")
    parser.add_argument(
        "--episodes", type=int, default=DRIVES, help=f"drives at most, the folder's last ones (default {DRIVES})"
    )
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Fit the controller, and print how well it agrees."""
    report = refit_controller(
        RefitRequest(args.controller, args.to, args.data, args.out, args.bundle, args.episodes, args.runs_dir)
    )
    print_answer(args, str(report), **report.facts)
    return 0
