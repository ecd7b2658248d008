"""`dreamfleet lab subspace`: fewer features for a search."""

import argparse
from pathlib import Path

from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.worker.addons.refit.stages import DRIVES, SubspaceRequest, fit_subspace

SUMMARY = "find a few features that predict a driver's actions and rewards, for a search among them (--subspace)"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("bundle", metavar="BUNDLE", help="the world model: a file, or one that ships")
    parser.add_argument("--data", type=Path, required=True, help="folder of the drives that it encodes")
    parser.add_argument("--out", type=Path, required=True, help="the subspace to write, NAME.npz")
    parser.add_argument(
        "--episodes", type=int, default=DRIVES, help=f"drives at most, the folder's last ones (default {DRIVES})"
    )
    parser.add_argument(
        "--views", type=int, default=0,
        help="add so many directions that predict what the model itself will see and remember (default 0)",
    )  # fmt: skip
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Find the features, and print how well each is predicted."""
    report = fit_subspace(SubspaceRequest(args.bundle, args.data, args.out, args.episodes, args.views))
    print_answer(args, str(report), **report.facts)
    return 0
