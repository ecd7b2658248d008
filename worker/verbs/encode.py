"""`dreamfleet encode`: pictures to latents."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.listing import add_json, answer

SUMMARY = "encode a data set's pictures with its trained VAE"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Encode what is not encoded yet."""
    from dreamfleet.worker.training.processor import spare_processor

    spare_processor()  # before torch is loaded
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.worker.training.dataset import episodes
    from dreamfleet.worker.training.encode import encode, mirrored_too

    total = len(episodes(args.data))
    frames = 0
    with progress_bar("encode", total, "episodes") as bar:
        for done, count in enumerate(encode(args.data), start=1):
            frames += count
            bar.move(done)
    also = ", each also mirrored" if mirrored_too(args.data) else ""
    answer(args, f"{args.data}: {frames} frames encoded{also}", data=args.data, new_frames=frames)
    return 0
