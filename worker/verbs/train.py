"""`dreamfleet train vae|mdnrnn`: train a part of a world model on a data set."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from dreamfleet.common.cli.command_line import SimpleVerb
from dreamfleet.common.cli.output import print_answer
from dreamfleet.common.printable import plural

if TYPE_CHECKING:
    from torch import nn

    from dreamfleet.common.host.stop_signals import Stop
    from dreamfleet.worker.training.train_vae import ReportProgress


def configure_vae(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `train vae`."""
    from dreamfleet.worker.training.config_flags import add_training_flags

    add_training_flags(parser, "vae")
    parser.add_argument(
        "--decoder-only", action="store_true", help="leave the encoder, and so latents and controllers, as they are"
    )


def train_vae(args: argparse.Namespace) -> int:
    """Train the VAE, and print its quality on held-out episodes."""
    from dreamfleet.worker.training.torch_setup import configure_process

    configure_process()  # before torch is loaded
    from dreamfleet.worker.training import train_vae as training
    from dreamfleet.worker.training.config_flags import apply_flags
    from dreamfleet.worker.training.data.data_folder import resolve_preset
    from dreamfleet.worker.training.presets import find_preset
    from dreamfleet.worker.training.training_cli import run_training
    from dreamfleet.worker.training.training_state import select_device
    from dreamfleet.worker.worldmodel.vae import VAE

    preset = find_preset(resolve_preset(args.data, args.preset))
    config, layers = apply_flags(preset.vae, args), apply_flags(preset.vae_layers, args)
    if args.summary:
        return _print_summary(args, VAE(layers))

    def train(report: ReportProgress, stop: Stop) -> dict[str, float]:
        device, other = select_device(args.device), args.continue_from
        return training.train_vae(args.data, config, report, layers, device, other, args.decoder_only, stop, args.new,
                                  args.tensorboard)  # fmt: skip

    return run_training(args, "VAE", config.updates, args.data / training.CHECKPOINT, train)


def configure_mdnrnn(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `train mdnrnn`."""
    from dreamfleet.worker.training.config_flags import add_training_flags

    add_training_flags(parser, "mdnrnn")


def train_mdnrnn(args: argparse.Namespace) -> int:
    """Train the MDN-RNN, and print its quality on held-out episodes."""
    from dreamfleet.worker.training.torch_setup import configure_process

    configure_process()  # before torch is loaded
    from dreamfleet.worker.training import train_mdnrnn as training
    from dreamfleet.worker.training.config_flags import apply_flags
    from dreamfleet.worker.training.data.data_folder import resolve_preset
    from dreamfleet.worker.training.encode import count_unencoded
    from dreamfleet.worker.training.presets import find_preset
    from dreamfleet.worker.training.training_cli import run_training
    from dreamfleet.worker.training.training_state import select_device
    from dreamfleet.worker.worldmodel.mdnrnn import MDNRNN
    from dreamfleet.worker.worldmodel.mdnrnn_config import ADDABLE_HEADS

    preset = find_preset(resolve_preset(args.data, args.preset))
    config, layers = apply_flags(preset.mdnrnn, args), apply_flags(preset.mdnrnn_layers, args)
    if args.summary:
        layers = training.fit_layers(layers, args.data, args.continue_from, args.new)
        return _print_summary(args, MDNRNN(layers), ADDABLE_HEADS)

    def train(report: ReportProgress, stop: Stop) -> dict[str, float]:
        device, other = select_device(args.device), args.continue_from
        return training.train_mdnrnn(args.data, config, report, layers, device, other, stop, args.new, args.tensorboard)

    if waiting := count_unencoded(args.data):
        note = f"note: not encoded or learnt from: {plural(waiting, 'drive')}; `dreamfleet encode --data {args.data}`"
        print(note, file=sys.stderr)
    return run_training(args, "MDN-RNN", config.updates, args.data / training.CHECKPOINT, train)


def _print_summary(args: argparse.Namespace, model: nn.Module, addable: frozenset[str] = frozenset()) -> int:
    from dreamfleet.worker.training.training_state import count_parameters, summarise_model

    text = summarise_model(model, args.continue_from, addable)
    print_answer(args, text, summary=text.splitlines(), parameters=count_parameters(model))
    return 0


VAE = SimpleVerb("train the VAE on a data set, or continue its training", configure_vae, train_vae, EXTRAS=("train",))
MDNRNN = SimpleVerb(
    "train the MDN-RNN on a data set, or continue its training", configure_mdnrnn, train_mdnrnn, EXTRAS=("train",)
)
