"""`dreamfleet baseline train`: a baseline that learns, trained in CarRacing."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.errors import UsageError

if TYPE_CHECKING:
    from dreamfleet.worker.baselines.progress import TrainingReport

SUMMARY = "train a network that drives from rewards alone, without a world model, or go on with it"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.baselines.presets import NAMES, PRESETS
    from dreamfleet.worker.training.config_flags import add_config_flags

    parser.add_argument("agent", choices=NAMES, help="drqn; random drivers learn nothing")
    parser.add_argument("--data", type=Path, required=True, help="folder of the training, and of what has learnt")
    parser.add_argument("--preset", default="learning", help=f"{preset_help_text('baseline')} (default learning)")
    parser.add_argument("--device", default="cpu", help="cpu, cuda, or auto (default cpu)")
    parser.add_argument("--new", action="store_true", help="begin anew where a checkpoint lies, which goes")
    add_config_flags(parser, "learning", {name: each.learning for name, each in PRESETS.items()})
    add_config_flags(parser, "layers and driving", {name: each.agent for name, each in PRESETS.items()})
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Train, with a report every few episodes on stderr, and print the figures."""
    from dreamfleet.worker.baselines.presets import DRQN, find_preset
    from dreamfleet.worker.training.config_flags import apply_flags

    if args.agent != DRQN:
        raise UsageError(f"{args.agent} learns nothing: `dreamfleet baseline evaluate {args.agent}` judges it")
    preset = find_preset(args.preset)
    config, layers = apply_flags(preset.learning, args), apply_flags(preset.agent, args)
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.common.host.stop_signals import stop_on_signals
    from dreamfleet.worker.baselines.train import CHECKPOINT, train_drqn
    from dreamfleet.worker.training.training_cli import explain_interrupt
    from dreamfleet.worker.training.training_state import select_device

    def report_progress(episodes: int, report: TrainingReport | None) -> None:
        bar.update(episodes)
        if report is not None:
            print(report, file=sys.stderr, flush=True)

    device = select_device(args.device)
    with (
        progress_bar(DRQN, config.episodes, "episodes") as bar,
        explain_interrupt(args.data / CHECKPOINT, args.new),
        stop_on_signals() as stop,
    ):
        figures = train_drqn(args.data, layers, config, report_progress, device, stop, args.new)
    print_answer(args, "  ".join(f"{name} {value}" for name, value in figures.items()), **figures)
    return 0
