"""`dreamfleet train mdnrnn`: train the MDN-RNN on a data set."""

from __future__ import annotations

import argparse

from dreamfleet.common.listing import answer

SUMMARY = "train the MDN-RNN on a data set, or go on with it"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.training.flags import add_training_flags
    from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig

    add_training_flags(parser, MDNRNNConfig)


def run(args: argparse.Namespace) -> int:
    """Train and print the quality on held-out episodes."""
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.common.stopping import heeding_signals
    from dreamfleet.worker.training.assemble import record_quality
    from dreamfleet.worker.training.flags import changed
    from dreamfleet.worker.training.presets import find_preset
    from dreamfleet.worker.training.schedule import device_of, summary
    from dreamfleet.worker.training.train_mdnrnn import train_mdnrnn
    from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN

    preset = find_preset(args.preset)
    config, layers = changed(preset.mdnrnn, args), changed(preset.mdnrnn_layers, args)
    if args.summary:
        print(summary(MDNRNN(layers)))
        return 0
    with progress_bar("MDN-RNN", config.updates, "updates") as bar, heeding_signals() as stop:
        device, other = device_of(args.device), args.continue_from
        figures = train_mdnrnn(args.data, config, bar.move, layers, device, other, stop)
    record_quality(args.data, figures)
    answer(args, "  ".join(f"{name} {value}" for name, value in figures.items()), **figures)
    return 0
