"""`dreamfleet train mdnrnn`: train the MDN-RNN on a data set."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from dreamfleet.common.listing import answer

if TYPE_CHECKING:
    from dreamfleet.common.stopping import Stop
    from dreamfleet.worker.training.train_vae import Report

SUMMARY = "train the MDN-RNN on a data set, or go on with it"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.training.flags import add_training_flags

    add_training_flags(parser, "mdnrnn")


def run(args: argparse.Namespace) -> int:
    """Train and print the quality on held-out episodes."""
    from dreamfleet.worker.training.processor import spare_processor

    spare_processor()  # before torch is loaded
    from dreamfleet.worker.training.encode import unencoded
    from dreamfleet.worker.training.flags import changed
    from dreamfleet.worker.training.origin import agreed_preset
    from dreamfleet.worker.training.presets import find_preset
    from dreamfleet.worker.training.schedule import device_of, learnt_parameters, summary
    from dreamfleet.worker.training.telling import show
    from dreamfleet.worker.training.train_mdnrnn import CHECKPOINT, train_mdnrnn
    from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
    from dreamfleet.worker.worldmodel.mdnrnn_config import HEADS_TO_COME

    preset = find_preset(agreed_preset(args.data, args.preset))
    config, layers = changed(preset.mdnrnn, args), changed(preset.mdnrnn_layers, args)
    if args.summary:
        model = MDNRNN(layers)
        text = summary(model, args.continue_from, HEADS_TO_COME)
        answer(args, text, summary=text.splitlines(), parameters=learnt_parameters(model))
        return 0

    def train(report: Report, stop: Stop) -> dict[str, float]:
        device, other = device_of(args.device), args.continue_from
        return train_mdnrnn(args.data, config, report, layers, device, other, stop, args.new, args.tensorboard)

    if waiting := unencoded(args.data):
        note = f"note: {waiting} drives are not encoded, and not learnt from: `dreamfleet encode --data {args.data}`"
        print(note, file=sys.stderr)
    return show(args, "MDN-RNN", config.updates, args.data / CHECKPOINT, train)
