"""`dreamfleet bundle`: freeze a trained world model."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.artifacts.bundle import MAX_RECORDED_STATES
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path

SUMMARY = "freeze a trained world model into one file that workers fetch by its hash"
EXTRAS = ("train",)
RECORDED = 512  # states of the default layers are 0.6 MB


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set and its trained models")
    parser.add_argument("--out", type=Path, required=True, help="the bundle to write, NAME.zip")
    parser.add_argument("--with-weights", action="store_true", help="keep the training weights in it")
    parser.add_argument(
        "--recorded", type=int, default=RECORDED, metavar="N",
        help=f"moments of the drives at which dreams may begin, with the model's memory; 0: none (default {RECORDED})",
    )  # fmt: skip
    parser.add_argument(
        "--measured", type=Path, nargs="+", default=[], metavar="FILE",
        help="figures to keep in its manifest, told by `inspect --json` (--probe, --losses, ...) of it without them",
    )  # fmt: skip
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Build the bundle and print its identity."""
    from dreamfleet.worker.training.assemble import assemble

    if not 0 <= args.recorded <= MAX_RECORDED_STATES:
        raise UsageError(f"--recorded must be from 0 to {MAX_RECORDED_STATES}, not {args.recorded}")
    check_output_path(args.out)
    bundle = assemble(
        args.data, args.out, args.out.stem, with_weights=args.with_weights, recorded=args.recorded,
        measured=args.measured,
    )  # fmt: skip
    size = bundle.path.stat().st_size / 1e6
    parameters = bundle.controller_shape.size
    states = bundle.recorded_count
    text = (
        f"{bundle.path}: {size:.1f} MB, sha256 {bundle.sha256}, controllers of {parameters} parameters, "
        f"{states} recorded states"
    )
    print_answer(args, text, bundle=bundle.path, bytes=bundle.path.stat().st_size, sha256=bundle.sha256,
           controller_parameters=parameters, recorded=states)  # fmt: skip
    return 0
