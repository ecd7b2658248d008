"""`dreamfleet unbundle`: a frozen world model as what training goes on from."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.cli.output import add_json_flag, print_answer

SUMMARY = "write a bundle's VAE and MDN-RNN as checkpoints that training goes on from"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("bundle", metavar="BUNDLE", help="a file, or one that ships")
    parser.add_argument(
        "--data", type=Path, required=True, help="folder of a data set, for its models; made if missing"
    )
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Write both checkpoints and say where they lie."""
    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.worker.training.unbundle import unbundle

    bundle = find_bundle(args.bundle)
    vae, mdnrnn = unbundle(bundle, args.data)
    print_answer(args, f"{vae} and {mdnrnn}, of {bundle.sha256[:12]}", vae=vae, mdnrnn=mdnrnn, bundle=bundle.sha256)
    return 0
