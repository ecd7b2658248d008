"""`dreamfleet pipeline`: a whole source, from drives to a bundle."""

from __future__ import annotations

import argparse
import json
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.command_line import build_parser
from dreamfleet.common.cli.global_config import complete_arguments
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.cli.presets import preset_help_text
from dreamfleet.common.cli.verb_runner import find_verb
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.host.stop_signals import interrupted_by_signals

if TYPE_CHECKING:
    from dreamfleet.worker.training.pipeline import Arguments

SUMMARY = "make a preset's whole world model: collect, train vae, encode, train mdnrnn, bundle; again, it goes on"
EXTRAS = ("train",)
EXAMPLES = {"collect": "--steps 200", "vae": "--batch 50", "mdnrnn": "--hidden 128"}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set; one that was begun goes on")
    parser.add_argument("--preset", help=preset_help_text("training"))
    parser.add_argument(
        "--scale", type=float, default=1.0, metavar="SHARE",
        help="share of the preset's drives, of each training's updates, and of those between two of its checkpoints "
        "(default 1)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="makes the drives and the trainings (default 0)")
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="processes that drive (default one a core)")
    parser.add_argument("--device", default="cpu", help="that trains: cpu, cuda, or auto (default cpu)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the bundle to write (default PRESET.zip in --data)")
    for name, example in EXAMPLES.items():
        text = f'flags of this stage alone, as one text: --{name}-flags="{example}"'
        parser.add_argument(f"--{name}-flags", default="", metavar="FLAGS", help=text)
    add_json_flag(parser)


@interrupted_by_signals()
def run(args: argparse.Namespace) -> int:
    """Go through the stages, each of which does what is left of it."""
    from dreamfleet.common.files.atomic_write import check_output_path
    from dreamfleet.worker.training.data.data_folder import check_seed, resolve_preset
    from dreamfleet.worker.training.pipeline import Pipeline
    from dreamfleet.worker.training.presets import find_preset

    preset = find_preset(resolve_preset(args.data, args.preset))
    check_seed(args.data, args.seed)
    flags = (args.collect_flags, args.vae_flags, args.mdnrnn_flags)
    source = Pipeline(preset, args.data, args.scale, args.seed, *flags)
    stages = source.stages(max(1, args.jobs), args.device, args.out)
    parsed = {name: _parse_stage(name, words) for name, words in stages.items()}  # what is wrong with them is said now
    check_output_path(args.out or source.bundle)
    told = {name: _run_stage(name, each, args.json) for name, each in parsed.items()}
    if args.json:
        print_answer(args, "", data=args.data, preset=preset.name, scale=args.scale, stages=told)
    return 0


def _parse_stage(name: str, words: Arguments) -> argparse.Namespace:
    args = build_parser(name, find_verb(name)).parse_all(words)
    complete_arguments(args)
    return args


def _run_stage(name: str, args: argparse.Namespace, capture: bool) -> Any:
    """Run a stage, which prints its answer; or return it, where it is to be heard."""
    if not capture:
        return find_verb(name).run(args)
    args.json = True
    with redirect_stdout(StringIO()) as said:
        find_verb(name).run(args)
    return json.loads(said.getvalue())
