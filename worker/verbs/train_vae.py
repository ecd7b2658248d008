"""`dreamfleet train vae`: train the VAE on a data set."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from dreamfleet.common.cli.output import print_answer

if TYPE_CHECKING:
    from dreamfleet.common.host.stop_signals import Stop
    from dreamfleet.worker.training.train_vae import ReportProgress

SUMMARY = "train the VAE on a data set, or go on with it"
EXTRAS = ("train",)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.training.config_flags import add_training_flags

    add_training_flags(parser, "vae")
    parser.add_argument(
        "--decoder-only", action="store_true", help="leave the encoder, and so latents and controllers, as they are"
    )


def run(args: argparse.Namespace) -> int:
    """Train and print the quality on held-out episodes."""
    from dreamfleet.worker.training.torch_setup import configure_process

    configure_process()  # before torch is loaded
    from dreamfleet.worker.training.config_flags import apply_flags
    from dreamfleet.worker.training.data.data_folder import resolve_preset
    from dreamfleet.worker.training.presets import find_preset
    from dreamfleet.worker.training.train_vae import CHECKPOINT, train_vae
    from dreamfleet.worker.training.training_cli import run_training
    from dreamfleet.worker.training.training_state import count_parameters, select_device, summarise_model
    from dreamfleet.worker.worldmodel.vae import VAE

    preset = find_preset(resolve_preset(args.data, args.preset))
    config, layers = apply_flags(preset.vae, args), apply_flags(preset.vae_layers, args)
    if args.summary:
        model = VAE(layers)
        text = summarise_model(model, args.continue_from)
        print_answer(args, text, summary=text.splitlines(), parameters=count_parameters(model))
        return 0

    def train(report: ReportProgress, stop: Stop) -> dict[str, float]:
        device, other = select_device(args.device), args.continue_from
        return train_vae(args.data, config, report, layers, device, other, args.decoder_only, stop, args.new,
                         args.tensorboard)  # fmt: skip

    return run_training(args, "VAE", config.updates, args.data / CHECKPOINT, train)
