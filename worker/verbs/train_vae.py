"""`dreamfleet train vae`: train the VAE on a data set."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from dreamfleet.common.listing import answer

if TYPE_CHECKING:
    from dreamfleet.common.stopping import Stop
    from dreamfleet.worker.training.train_vae import Report

SUMMARY = "train the VAE on a data set, or go on with it"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.training.flags import add_training_flags

    add_training_flags(parser, "vae")
    parser.add_argument(
        "--decoder-only", action="store_true", help="leave the encoder, and so latents and controllers, as they are"
    )


def run(args: argparse.Namespace) -> int:
    """Train and print the quality on held-out episodes."""
    from dreamfleet.worker.training.processor import spare_processor

    spare_processor()  # before torch is loaded
    from dreamfleet.worker.training.flags import changed
    from dreamfleet.worker.training.origin import agreed_preset
    from dreamfleet.worker.training.presets import find_preset
    from dreamfleet.worker.training.schedule import device_of, learnt_parameters, summary
    from dreamfleet.worker.training.telling import show
    from dreamfleet.worker.training.train_vae import CHECKPOINT, train_vae
    from dreamfleet.worker.worldmodel.vae import VAE

    preset = find_preset(agreed_preset(args.data, args.preset))
    config, layers = changed(preset.vae, args), changed(preset.vae_layers, args)
    if args.summary:
        model = VAE(layers)
        text = summary(model, args.continue_from)
        answer(args, text, summary=text.splitlines(), parameters=learnt_parameters(model))
        return 0

    def train(report: Report, stop: Stop) -> dict[str, float]:
        device, other = device_of(args.device), args.continue_from
        return train_vae(args.data, config, report, layers, device, other, args.decoder_only, stop, args.new,
                         args.tensorboard)  # fmt: skip

    return show(args, "VAE", config.updates, args.data / CHECKPOINT, train)
