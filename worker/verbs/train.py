"""`dreamfleet train MODEL`: train a part of a world model, its VAE or its MDN-RNN, on a data set."""

import argparse
import sys
from pathlib import Path
from typing import Any

from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.common.printable import plural
from dreamfleet.worker.training.stages.train import MDNRNN, MODELS, VAE, TrainRequest, summarise, train_model

SUMMARY = "train a world model's VAE or MDN-RNN on a data set, or continue its training"
EXTRAS = ("train",)
FIRST = "--preset --device --continue-from --new --summary --updates --batch --rate --seed --set --tensorboard --json"
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
        "--new",
        action="store_true",
        help="begin anew: delete the folder's checkpoint, its curve and the checkpoints that keep_every kept",
    )
    parser.add_argument(
        "--decoder-only",
        action="store_true",
        help="of vae: leave the encoder, and so latents and controllers, as they are",
    )
    parser.add_argument(
        "--summary",
        action="store_true",
        help="print layers and parameters without training; a model to continue from must have these layers",
    )
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


def make_request(args: argparse.Namespace) -> TrainRequest:
    """The training that the flags, the file and the environment ask for."""
    from dreamfleet.worker.training.config_flags import given_settings
    from dreamfleet.worker.training.presets import PRESETS

    parts = (args.model, f"{args.model}_layers")
    kinds = [type(getattr(next(iter(PRESETS.values())), part)) for part in parts]
    return TrainRequest(
        args.model, args.data, args.preset, given_settings(kinds, args.model, args), args.device, args.continue_from,
        args.new, args.decoder_only, args.tensorboard,
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Train the model, and print its quality on held-out episodes."""
    from dreamfleet.worker.training.data.data_folder import resolve_preset

    request = make_request(args)
    if args.summary:
        summary = summarise(request)
        print_answer(args, str(summary), **summary.facts)
        return 0
    if args.model == MDNRNN:
        _note_unencoded(args.data)
    with stop_on_signals() as stop:
        report = train_model(request, stop)
    print_answer(args, str(report), **report.facts)
    bundle = ("bundle", "--data", args.data, "--out", args.data / f"{resolve_preset(args.data, args.preset)}.zip")
    print_next(args, ("encode", "--data", args.data) if args.model == VAE else bundle)
    return 0


def _note_unencoded(data: Path) -> None:
    """Say on stderr which drives are not learnt from."""
    from dreamfleet.worker.training.torch_setup import configure_process

    configure_process()  # before torch is loaded
    from dreamfleet.worker.training.encode import count_unencoded

    if waiting := count_unencoded(data):
        encode = shell_command("encode", "--data", data)
        print(f"note: not encoded or learnt from: {plural(waiting, 'drive')}; `{encode}`", file=sys.stderr)
