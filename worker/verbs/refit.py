"""`dreamfleet refit`: a controller for another world model."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from dreamfleet.common.errors import UsageError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.saving import check_out, told
from dreamfleet.common.site import offer
from dreamfleet.common.threads import pin_thread_pools

SUMMARY = "fit a controller to another world model, so that it chooses there what it chose, on recorded drives"
EXTRAS = ("worker",)
DRIVES = 300


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("controller", metavar="CONTROLLER", help="a file, a run, or one that ships")
    parser.add_argument("--to", required=True, metavar="BUNDLE", help="the world model it is to drive by")
    parser.add_argument("--data", type=Path, required=True, help="folder of the drives that both models watch")
    parser.add_argument("--out", type=Path, required=True, help="the controller to write, NAME.npz")
    parser.add_argument("--bundle", help="the world model that it was evolved with, where it is not found")
    parser.add_argument(
        "--episodes", type=int, default=DRIVES, help=f"drives at most, the folder's last ones (default {DRIVES})"
    )
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Fit it and say how well that went."""
    pin_thread_pools()  # of NumPy, which is not loaded yet
    if args.episodes < 2:
        raise UsageError(f"--episodes must be at least 2, not {args.episodes}")
    check_out(args.out)
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.common.shelf import bundle_for, find_controller
    from dreamfleet.common.store import find_bundle
    from dreamfleet.worker.training.refit import last_drives, outputs_of, refit

    controller, beside = find_controller(args.controller, args.runs_dir)
    own = bundle_for(controller, args.bundle, beside)
    if own is None:
        raise UsageError(f"controller {args.controller} sees no world model: give one that was evolved with one")
    paths = last_drives(args.data, args.episodes)
    with progress_bar("refit", len(paths), "drives") as bar:
        fitted = refit(controller, own, find_bundle(args.to), paths, bar.move)
    with told(args.out):
        fitted.controller.save(args.out)
    r_squared = [None if math.isnan(each) else round(each, 4) for each in fitted.r_squared]
    spoken = ", ".join(f"{name} {'not told' if each is None else f'{each:.2f}'}"
                       for name, each in zip(outputs_of(fitted.controller, own), r_squared, strict=False))  # fmt: skip
    text = f"{args.out}: fitted on {fitted.steps} steps of {fitted.drives} drives; R² on held-out ones: {spoken}"
    if None in r_squared:
        text += " (too few drives, or it never moves)"
    if not fitted.drives:
        text = f"{args.out}: the same parameters, since both models see and remember alike"
    answer(args, text, controller=args.out, sha256=fitted.controller.sha256, bundle=fitted.controller.bundle,
           drives=fitted.drives, steps=fitted.steps, r_squared=r_squared)  # fmt: skip
    return 0
