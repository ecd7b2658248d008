"""`dreamfleet lab refit`: a controller for another world model."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path, reporting_write_errors
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.printable import plural

SUMMARY = "fit a controller to another world model, so that it acts there as before, by regression on recorded drives"
EXTRAS = ("worker",)
DRIVES = 300


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
    pin_thread_pools()  # of NumPy, which is not loaded yet
    if args.episodes < 2:
        raise UsageError(f"--episodes must be at least 2, not {args.episodes}")
    check_output_path(args.out)
    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
    from dreamfleet.worker.training.drive_regression import last_drives
    from dreamfleet.worker.training.refit import output_names, refit

    controller, beside = find_controller(args.controller, args.runs_dir)
    own = find_bundle_of(controller, args.bundle, beside)
    if own is None:
        raise UsageError(f"controller {args.controller} sees no world model: give one that was evolved with one")
    paths = last_drives(args.data, args.episodes)
    with progress_bar("refit", len(paths), "drives") as bar:
        fitted = refit(controller, own, find_bundle(args.to), paths, bar.update)
    with reporting_write_errors(args.out):
        fitted.controller.save(args.out)
    r_squared = [None if math.isnan(each) else round(each, 4) for each in fitted.r_squared]
    spoken = ", ".join(
        f"{name} {'unknown' if each is None else f'{each:z.2f}'}"
        for name, each in zip(output_names(fitted.controller, own), r_squared, strict=False)
    )
    text = (
        f"{args.out}: fitted on {plural(fitted.steps, 'step')} of {plural(fitted.drives, 'drive')}; R² on "
        f"held-out ones: {spoken}"
    )
    if None in r_squared:
        text += " (too few drives, or it never moves)"
    if not fitted.drives:
        text = f"{args.out}: the same parameters, since both models see and remember alike"
    print_answer(args, text, controller=args.out, sha256=fitted.controller.sha256, bundle=fitted.controller.bundle,
           drives=fitted.drives, steps=fitted.steps, r_squared=r_squared)  # fmt: skip
    return 0
