"""`dreamfleet baseline train`: a baseline that learns, trained in CarRacing."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.errors import UsageError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.presets import preset_help

if TYPE_CHECKING:
    from dreamfleet.worker.baselines.reports import Report

SUMMARY = "train a network that drives from rewards alone, without a world model, or go on with it"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.baselines.names import NAMES
    from dreamfleet.worker.baselines.presets import PRESETS
    from dreamfleet.worker.training.flags import add_config_flags

    parser.add_argument("agent", choices=NAMES, help="drqn; random drivers learn nothing")
    parser.add_argument("--data", type=Path, required=True, help="folder of the training, and of what has learnt")
    parser.add_argument("--preset", default="learning", help=f"{preset_help('baseline')} (default learning)")
    parser.add_argument("--device", default="cpu", help="cpu, cuda, or auto (default cpu)")
    parser.add_argument("--new", action="store_true", help="begin anew where a checkpoint lies, which goes")
    add_config_flags(parser, "learning", {name: each.learning for name, each in PRESETS.items()})
    add_config_flags(parser, "layers and driving", {name: each.agent for name, each in PRESETS.items()})
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Train, with a report every few episodes on stderr, and print the figures."""
    from dreamfleet.worker.baselines.names import DRQN
    from dreamfleet.worker.baselines.presets import find_preset
    from dreamfleet.worker.training.flags import changed

    if args.agent != DRQN:
        raise UsageError(f"{args.agent} learns nothing: `dreamfleet baseline evaluate {args.agent}` judges it")
    preset = find_preset(args.preset)
    config, layers = changed(preset.learning, args), changed(preset.agent, args)
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.common.stopping import heeding_signals
    from dreamfleet.worker.baselines.train import CHECKPOINT, train_drqn
    from dreamfleet.worker.training.ending import told_what_is_kept
    from dreamfleet.worker.training.schedule import device_of

    def hear(episodes: int, report: Report | None) -> None:
        bar.move(episodes)
        if report is not None:
            print(report, file=sys.stderr, flush=True)

    device = device_of(args.device)
    with (
        progress_bar(DRQN, config.episodes, "episodes") as bar,
        told_what_is_kept(args.data / CHECKPOINT, args.new),
        heeding_signals() as stop,
    ):
        figures = train_drqn(args.data, layers, config, hear, device, stop, args.new)
    answer(args, "  ".join(f"{name} {value}" for name, value in figures.items()), **figures)
    return 0
