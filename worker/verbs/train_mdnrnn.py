"""`dreamfleet train mdnrnn`: train the MDN-RNN on a data set."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

SUMMARY = "train the MDN-RNN on a data set, or go on with it"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--preset", default="tiny", help="how much of everything (default tiny)")
    parser.add_argument("--updates", type=int, help="updates in all, instead of the preset's")


def run(args: argparse.Namespace) -> int:
    """Train and print the quality on held-out episodes."""
    from common.progress import progress_bar
    from worker.training.assemble import record_quality
    from worker.training.presets import find_preset
    from worker.training.train_mdnrnn import train_mdnrnn

    config = find_preset(args.preset).mdnrnn
    config = replace(config, updates=args.updates or config.updates)
    with progress_bar("MDN-RNN", config.updates, "updates") as bar:
        figures = train_mdnrnn(args.data, config, bar.move)
    record_quality(args.data, figures)
    print("  ".join(f"{name} {value}" for name, value in figures.items()))
    return 0
