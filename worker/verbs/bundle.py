"""`dreamfleet bundle`: freeze a trained world model."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.listing import add_json, answer

SUMMARY = "freeze a trained world model into one file that workers fetch by its hash"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set and its trained models")
    parser.add_argument("--out", type=Path, required=True, help="the bundle to write, NAME.zip")
    parser.add_argument("--with-weights", action="store_true", help="keep the training weights in it")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Build the bundle and print its identity."""
    from dreamfleet.worker.training.assemble import assemble

    bundle = assemble(args.data, args.out, args.out.stem, with_weights=args.with_weights)
    size = bundle.path.stat().st_size / 1e6
    parameters = bundle.controller_shape.size
    text = f"{bundle.path}: {size:.1f} MB, sha256 {bundle.sha256}, controllers of {parameters} parameters"
    answer(args, text, bundle=bundle.path, bytes=bundle.path.stat().st_size, sha256=bundle.sha256,
           controller_parameters=parameters)  # fmt: skip
    return 0
