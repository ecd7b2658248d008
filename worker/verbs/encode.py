"""`dreamfleet encode`: pictures to latents."""

import argparse
from pathlib import Path

from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.worker.training.stages.encode import EncodeRequest, encode_drives

SUMMARY = "encode a data set's pictures with its trained VAE"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Encode the drives that are not encoded yet."""
    report = encode_drives(EncodeRequest(args.data))
    print_answer(args, str(report), **report.facts)
    print_next(args, ("train", "mdnrnn", "--data", args.data))
    return 0
