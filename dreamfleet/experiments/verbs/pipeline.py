"""`dreamfleet pipeline`: a world model from nothing, drives to bundle."""

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.cli.key_values import split_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.cli.world_flags import add_world_flags, world_arguments
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path
from dreamfleet.common.host.packages import check_modules
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.experiments.pipeline import PipelineRequest, make_world_model, parse_flags, read_bundle, read_training
from dreamfleet.worker.addons.bundles.verb import use_bundle
from dreamfleet.worker.training.stages import StageReport
from dreamfleet.worker.training.stages.train import Model, TrainRequest
from dreamfleet.worker.verbs import collect

if TYPE_CHECKING:
    from dreamfleet.worker.training.presets import TrainConfig

SUMMARY = "make a preset's world model: collect, train vae, encode, train mdnrnn, bundle; run again, it resumes"
EXTRAS = ("train",)
FIRST = "--preset --task --environment --scale --seed --jobs --device --out --vae-flags --mdnrnn-flags --json"
RESERVED_FLAGS = (  # of the stages, which pipeline sets for each
    "--data", "--preset", "--seed", "--json", "--new", "--summary", "--from-run", "--out", "--extract",
)  # fmt: skip
LEAST_DRIVES = 2  # one for training, one held out
EXAMPLES = {"collect": "--steps 200", "vae": "--batch 50", "mdnrnn": "--set hidden=128", "bundle": "--reward value"}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set; a begun one is resumed")
    parser.add_argument("--preset", help=preset_help_text("training"))
    add_world_flags(parser)
    parser.add_argument(
        "--scale", type=float, default=1.0, metavar="SHARE",
        help="share of the preset's drives, of each training's updates, and of those between two of its checkpoints "
        "(default 1)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="seed of the drives and trainings (default 0)")
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="processes that drive (default one per core)")
    parser.add_argument("--device", default="cpu", help="for training: cpu, cuda, or auto (default cpu)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the bundle to write (default PRESET.zip in --data)")
    for name, example in EXAMPLES.items():
        text = f'flags of this stage only, as one text: --{name}-flags="{example}"'
        parser.add_argument(f"--{name}-flags", default="", metavar="FLAGS", help=text)
    parser.add_argument(
        "--yes", action="store_true",
        help="go on where the VAE is no better than the mean picture, which ends the command otherwise",
    )  # fmt: skip
    add_json_flag(parser)


def make_request(args: argparse.Namespace) -> PipelineRequest:
    """The stages by the flags, and by what the data folder was begun with; `UsageError` for wrong ones."""
    from dreamfleet.worker.training.data.data_folder import check_seed, resolve_preset, resolve_world
    from dreamfleet.worker.training.presets import find_preset

    data, world = args.data, world_arguments(args)
    preset = find_preset(resolve_preset(data, args.preset, resolve_world(data, args.task, world)))
    check_seed(data, args.seed)
    if not 0 < args.scale <= 1:
        raise UsageError(f"--scale must be above 0, to 1, not {args.scale:g}")

    def scale(amount: int, least: int = 1) -> int:
        return max(least, math.ceil(round(float(amount * args.scale), 6)))

    def flags(name: str) -> tuple[str, ...]:
        config = ("--config", str(args.config)) if getattr(args, "config", None) else ()  # its tables hold for stages
        return (*split_flags(f"--{name}-flags", getattr(args, f"{name}_flags"), "pipeline", RESERVED_FLAGS), *config)

    def training(model: Model, config: "TrainConfig") -> TrainRequest:
        # Updates, and those between checks on held-out drives, by scale: so there are as many checks at any scale.
        amounts = ("--updates", scale(config.updates), "--set", f"validate_every={scale(config.validate_every)}")
        words = ("--device", args.device, *amounts, *flags(model))
        return replace(read_training(model, data, args.seed, *words), preset=preset.name)

    episodes = scale(preset.collect.episodes, LEAST_DRIVES)
    words = ("--data", data, "--jobs", max(1, args.jobs), "--episodes", episodes, *flags("collect"))
    driven = collect.make_request(parse_flags("collect", collect, words))
    driven = replace(driven, preset=preset.name, task=driven.task or args.task, world={**world, **driven.world},
                     settings={**driven.settings, "seed": args.seed})  # fmt: skip
    out = args.out or data / f"{preset.name}.zip"
    made = read_bundle(data, out, *flags("bundle"))
    return PipelineRequest(driven, training("vae", preset.vae), training("mdnrnn", preset.mdnrnn), made, args.yes)


def run(args: argparse.Namespace) -> int:
    """Run the stages, each of which does what is left of it."""
    request = make_request(args)
    check_modules(("gymnasium", "onnx", "onnxruntime", "safetensors", "torch"))
    check_output_path(request.bundle.out)

    def show(_name: str, report: StageReport) -> None:
        if not args.json:
            print_answer(args, str(report))

    with stop_on_signals() as stop:
        reports = make_world_model(request, stop, show)
    if args.json:
        stages = {name: each.facts for name, each in reports.items()}
        print_answer(args, "", data=args.data, preset=request.collect.preset, scale=args.scale, stages=stages)
    print_next(args, *use_bundle(request.bundle.out))
    return 0
