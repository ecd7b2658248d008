"""`dreamfleet lab subspace`: fewer features for a search."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path, reporting_write_errors
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.printable import plural

SUMMARY = "find a few features that predict a driver's actions and rewards, for a search among them (--subspace)"
EXTRAS = ("worker",)
DRIVES = 300


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
    pin_thread_pools()  # of NumPy, which is not loaded yet
    if args.episodes < 5:
        raise UsageError(f"--episodes must be at least 5, not {args.episodes}: every fifth is held out")
    if args.views < 0:
        raise UsageError(f"--views must not be negative, not {args.views}")
    check_output_path(args.out)
    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.training.drive_regression import last_drives
    from dreamfleet.worker.training.fit_subspace import find_subspace

    bundle, paths = find_bundle(args.bundle), last_drives(args.data, args.episodes)
    with progress_bar("subspace", len(paths), "drives") as bar:
        found = find_subspace(bundle, paths, bar.update, args.views)
    subspace, r_squared = found.subspace, [round(each, 4) for each in found.r_squared]
    with reporting_write_errors(args.out):
        subspace.save(args.out, {"drives": found.drives, "steps": found.steps, "r_squared": r_squared})
    width = max(map(len, subspace.names))
    rows = [f"{name:<{width}}  {each:z.2f}" for name, each in zip(subspace.names, r_squared, strict=True)]
    heading = "what is predicted, how many steps ahead, and its R² on held-out drives:"
    last = (
        f"{args.out}: {plural(len(rows), 'feature')}, by {plural(found.steps, 'step')} of "
        f"{plural(found.drives, 'drive')}"
    )
    text = "\n".join([heading, *rows, last])
    print_answer(args, text, subspace=args.out, sha256=subspace.sha256, bundle=bundle.sha256, features=subspace.names,
           r_squared=r_squared, drives=found.drives, steps=found.steps)  # fmt: skip
    return 0
