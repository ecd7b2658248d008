"""`dreamfleet encode`: pictures to latents."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.common.printable import plural

SUMMARY = "encode a data set's pictures with its trained VAE"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Encode the drives that are not encoded yet."""
    from dreamfleet.worker.training.torch_setup import configure_process

    configure_process()  # before torch is loaded
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.training.data.dataset import episode_paths
    from dreamfleet.worker.training.encode import encode, encodes_mirrored

    total = len(episode_paths(args.data))
    frames = 0
    with progress_bar("encode", total, "episodes") as bar:
        for done, count in enumerate(encode(args.data), start=1):
            frames += count
            bar.update(done)
        bar.update(total)  # with those that were encoded before
    also = ", each also mirrored" if encodes_mirrored(args.data) else ""
    print_answer(args, f"{args.data}: {plural(frames, 'frame')} encoded{also}", data=args.data, new_frames=frames)
    print_next(args, ("train", "mdnrnn", "--data", args.data))
    return 0
