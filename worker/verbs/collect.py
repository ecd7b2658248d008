"""`dreamfleet collect`: random drives as training data."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

SUMMARY = "drive at random and keep what was seen, as training data for a world model"
EXTRAS = ("worker",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--preset", default="tiny", help="how much of everything (default tiny)")
    parser.add_argument("--episodes", type=int, help="episodes in all, instead of the preset's")
    parser.add_argument("--seed", type=int, help="makes the data set, instead of the preset's")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default one a core)")


def run(args: argparse.Namespace) -> int:
    """Collect what is missing."""
    from common.progress import progress_bar
    from worker.training.collect import collect
    from worker.training.presets import find_preset

    config = find_preset(args.preset).collect
    changes = {name: getattr(args, name) for name in ("episodes", "seed") if getattr(args, name) is not None}
    config = replace(config, **changes)
    frames = done = 0
    with progress_bar("collect", config.episodes, "episodes") as bar:
        for count in collect(args.data, config, max(1, args.jobs)):
            frames, done = frames + count, done + 1
            bar.move(done)
    print(f"{args.data}: {done} episodes, {frames} frames new; {config.episodes} episodes in all")
    return 0
