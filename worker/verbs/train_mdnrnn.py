"""`dreamfleet train mdnrnn`: train the MDN-RNN on a data set."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from dreamfleet.common.cli.output import print_answer

if TYPE_CHECKING:
    from dreamfleet.common.host.stop_signals import Stop
    from dreamfleet.worker.training.train_vae import ReportProgress

SUMMARY = "train the MDN-RNN on a data set, or go on with it"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.training.config_flags import add_training_flags

    add_training_flags(parser, "mdnrnn")


def run(args: argparse.Namespace) -> int:
    """Train and print the quality on held-out episodes."""
    from dreamfleet.worker.training.torch_setup import configure_process

    configure_process()  # before torch is loaded
    from dreamfleet.worker.training.config_flags import apply_flags
    from dreamfleet.worker.training.data.data_folder import resolve_preset
    from dreamfleet.worker.training.encode import count_unencoded
    from dreamfleet.worker.training.presets import find_preset
    from dreamfleet.worker.training.train_mdnrnn import CHECKPOINT, train_mdnrnn
    from dreamfleet.worker.training.training_cli import run_training
    from dreamfleet.worker.training.training_state import count_parameters, select_device, summarise_model
    from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
    from dreamfleet.worker.worldmodel.mdnrnn_config import ADDABLE_HEADS

    preset = find_preset(resolve_preset(args.data, args.preset))
    config, layers = apply_flags(preset.mdnrnn, args), apply_flags(preset.mdnrnn_layers, args)
    if args.summary:
        model = MDNRNN(layers)
        text = summarise_model(model, args.continue_from, ADDABLE_HEADS)
        print_answer(args, text, summary=text.splitlines(), parameters=count_parameters(model))
        return 0

    def train(report: ReportProgress, stop: Stop) -> dict[str, float]:
        device, other = select_device(args.device), args.continue_from
        return train_mdnrnn(args.data, config, report, layers, device, other, stop, args.new, args.tensorboard)

    if waiting := count_unencoded(args.data):
        note = f"note: {waiting} drives are not encoded, and not learnt from: `dreamfleet encode --data {args.data}`"
        print(note, file=sys.stderr)
    return run_training(args, "MDN-RNN", config.updates, args.data / CHECKPOINT, train)
