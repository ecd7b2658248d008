"""`dreamfleet pipeline`: a world model from nothing, drives to bundle."""

from __future__ import annotations

import argparse
from pathlib import Path

from dreamfleet.common.cli.model_commands import use_bundle, world_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.cli.verb_runner import InProcessRunner
from dreamfleet.common.cli.world_flags import add_world_flags, world_arguments
from dreamfleet.common.host.packages import check_modules
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.stop_signals import interrupted_by_signals

SUMMARY = "make a preset's world model: collect, train vae, encode, train mdnrnn, bundle; run again, it resumes"
EXTRAS = ("train",)
EXAMPLES = {"collect": "--steps 200", "vae": "--batch 50", "mdnrnn": "--set hidden=128", "bundle": "--reward value"}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "--data", type=Path, required=True, help="folder of the data set; one that was begun is resumed"
    )
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


@interrupted_by_signals()
def run(args: argparse.Namespace) -> int:
    """Run the stages, each of which does what is left of it."""
    from dreamfleet.common.files.atomic_write import check_output_path
    from dreamfleet.worker.training.data.data_folder import check_seed, resolve_preset, resolve_world
    from dreamfleet.worker.training.pipeline import VAE, Pipeline
    from dreamfleet.worker.training.presets import find_preset

    world = resolve_world(args.data, args.task, world_arguments(args))
    preset = find_preset(resolve_preset(args.data, args.preset, world))
    check_seed(args.data, args.seed)
    flags = (world_flags(vars(args)), args.collect_flags, args.vae_flags, args.mdnrnn_flags, args.bundle_flags)
    source = Pipeline(preset, args.data, args.scale, args.seed, *flags)
    check_modules(("gymnasium", "onnx", "onnxruntime", "safetensors", "torch"))
    config = getattr(args, "config", None)  # its tables [vae] and [mdnrnn] hold for the stages
    file = ("--config", str(config)) if config else ()
    stages = source.stages(max(1, args.jobs), args.device, args.out)
    runner = InProcessRunner({name: (*words, *file) for name, words in stages.items()})  # wrong flags end it here
    check_output_path(args.out or source.bundle)

    def check(stage: str) -> None:
        if stage == VAE and not args.yes:
            source.check_vae()

    if not args.json:
        runner.run_all(check)
        print_next(args, *use_bundle(args.out or source.bundle))
        return 0
    answers = runner.run_all_for_json(check)
    print_answer(args, "", data=args.data, preset=preset.name, scale=args.scale, stages=answers)
    return 0
