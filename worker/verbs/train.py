"""`dreamfleet train MODEL`: train a part of a world model, its VAE or its MDN-RNN, on a data set."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.model_commands import MODELS
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural

if TYPE_CHECKING:
    from torch import nn

    from dreamfleet.common.host.stop_signals import Stop
    from dreamfleet.worker.training.train_vae import ReportProgress

SUMMARY = "train a world model's VAE or MDN-RNN on a data set, or continue its training"
EXTRAS = ("train",)
VAE, MDNRNN = MODELS
TRAINING_FLAGS = ("updates", "batch", "rate", "seed")  # other settings are keys of --set


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.training.config_flags import add_config_flags, add_settings_flag
    from dreamfleet.worker.training.presets import PRESETS

    parser.add_argument("model", metavar="MODEL", choices=MODELS, help="vae, or mdnrnn once `encode` has run")
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set")
    parser.add_argument("--preset", help=preset_help_text("training"))
    parser.add_argument("--device", default="cpu", help="cpu, cuda, or auto (default cpu)")
    parser.add_argument("--continue-from", type=Path, metavar="FILE", help="begin from this checkpoint's weights")
    parser.add_argument(
        "--new", action="store_true",
        help="begin anew: delete the folder's checkpoint, its curve and the checkpoints that keep_every kept",
    )  # fmt: skip
    parser.add_argument(
        "--decoder-only", action="store_true",
        help="of vae: leave the encoder, and so latents and controllers, as they are",
    )  # fmt: skip
    parser.add_argument(
        "--summary", action="store_true",
        help="print layers and parameters without training; a model to continue from must have these layers",
    )  # fmt: skip
    parser.add_argument(
        "--tensorboard", type=Path, metavar="FOLDER", help="also write the losses there as TensorBoard events"
    )
    add_json_flag(parser)
    training = {name: each.vae for name, each in PRESETS.items()}
    add_config_flags(parser, "training", training, TRAINING_FLAGS, shows_default=False)
    tables: dict[str, list[dict[str, Any]]] = {
        model: [{name: getattr(each, part) for name, each in PRESETS.items()} for part in (model, f"{model}_layers")]
        for model in MODELS
    }
    add_settings_flag(parser, tables, TRAINING_FLAGS)


def run(args: argparse.Namespace) -> int:
    """Train the model, and print its quality on held-out episodes."""
    from dreamfleet.worker.training.torch_setup import configure_process

    configure_process()  # before torch is loaded
    if args.model == VAE:
        return _train_vae(args)
    if args.decoder_only:
        raise UsageError("--decoder-only is of the VAE: omit it")
    return _train_mdnrnn(args)


def _train_vae(args: argparse.Namespace) -> int:
    from dreamfleet.worker.training import train_vae as training
    from dreamfleet.worker.training.config_flags import apply_settings
    from dreamfleet.worker.training.data.data_folder import resolve_preset
    from dreamfleet.worker.training.presets import find_preset
    from dreamfleet.worker.training.training_cli import run_training
    from dreamfleet.worker.training.training_state import select_device
    from dreamfleet.worker.worldmodel import vae

    preset = find_preset(resolve_preset(args.data, args.preset))
    config, layers = apply_settings((preset.vae, preset.vae_layers), VAE, args)
    if args.summary:
        return _print_summary(args, vae.VAE(layers))

    def train(report: ReportProgress, stop: Stop) -> dict[str, float]:
        device, other = select_device(args.device), args.continue_from
        return training.train_vae(args.data, config, report, layers, device, other, args.decoder_only, stop, args.new,
                                  args.tensorboard)  # fmt: skip

    code = run_training(args, "VAE", config.updates, args.data / training.CHECKPOINT, train)
    print_next(args, ("encode", "--data", args.data))
    return code


def _train_mdnrnn(args: argparse.Namespace) -> int:
    from dreamfleet.worker.training import train_mdnrnn as training
    from dreamfleet.worker.training.config_flags import apply_settings
    from dreamfleet.worker.training.data.data_folder import resolve_preset
    from dreamfleet.worker.training.encode import count_unencoded
    from dreamfleet.worker.training.presets import find_preset
    from dreamfleet.worker.training.training_cli import run_training
    from dreamfleet.worker.training.training_state import select_device
    from dreamfleet.worker.worldmodel import mdnrnn
    from dreamfleet.worker.worldmodel.mdnrnn_config import ADDABLE_HEADS

    preset = find_preset(resolve_preset(args.data, args.preset))
    config, layers = apply_settings((preset.mdnrnn, preset.mdnrnn_layers), MDNRNN, args)
    if args.summary:
        layers = training.fit_layers(layers, args.data, args.continue_from, args.new)
        return _print_summary(args, mdnrnn.MDNRNN(layers), ADDABLE_HEADS)

    def train(report: ReportProgress, stop: Stop) -> dict[str, float]:
        device, other = select_device(args.device), args.continue_from
        return training.train_mdnrnn(args.data, config, report, layers, device, other, stop, args.new, args.tensorboard)

    if waiting := count_unencoded(args.data):
        note = f"note: not encoded or learnt from: {plural(waiting, 'drive')}; `dreamfleet encode --data {args.data}`"
        print(note, file=sys.stderr)
    code = run_training(args, "MDN-RNN", config.updates, args.data / training.CHECKPOINT, train)
    print_next(args, ("bundle", "--data", args.data, "--out", args.data / f"{preset.name}.zip"))
    return code


def _print_summary(args: argparse.Namespace, model: nn.Module, addable: frozenset[str] = frozenset()) -> int:
    from dreamfleet.worker.training.training_state import count_parameters, summarise_model

    text = summarise_model(model, args.continue_from, addable)
    print_answer(args, text, summary=text.splitlines(), parameters=count_parameters(model))
    return 0
