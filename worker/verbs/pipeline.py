"""`dreamfleet pipeline`: a whole source, from drives to a bundle."""

from __future__ import annotations

import argparse
import json
from contextlib import redirect_stdout
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli import parser_of
from dreamfleet.common.cores import cores
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.presets import preset_help
from dreamfleet.common.site import settle

if TYPE_CHECKING:
    from dreamfleet.worker.training.source import Words

SUMMARY = "make a preset's whole world model: collect, train vae, encode, train mdnrnn, bundle; again, it goes on"
EXTRAS = ("train",)
EXAMPLES = {"collect": "--steps 200", "vae": "--batch 50", "mdnrnn": "--hidden 128"}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--data", type=Path, required=True, help="folder of the data set; one that was begun goes on")
    parser.add_argument("--preset", help=preset_help("training"))
    parser.add_argument(
        "--scale", type=float, default=1.0, metavar="SHARE",
        help="share of the preset's drives, of each training's updates, and of those between two of its checkpoints "
        "(default 1)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=0, help="makes the drives and the trainings (default 0)")
    parser.add_argument("--jobs", type=int, default=cores(), help="processes that drive (default one a core)")
    parser.add_argument("--device", default="cpu", help="that trains: cpu, cuda, or auto (default cpu)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the bundle to write (default PRESET.zip in --data)")
    for name, example in EXAMPLES.items():
        text = f'flags of this stage alone, as one text: --{name}-flags="{example}"'
        parser.add_argument(f"--{name}-flags", default="", metavar="FLAGS", help=text)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Go through the stages, each of which does what is left of it."""
    from dreamfleet.common.saving import check_out
    from dreamfleet.worker.training.origin import agreed_preset, check_seed
    from dreamfleet.worker.training.presets import find_preset
    from dreamfleet.worker.training.source import Source

    preset = find_preset(agreed_preset(args.data, args.preset))
    check_seed(args.data, args.seed)
    flags = (args.collect_flags, args.vae_flags, args.mdnrnn_flags)
    source = Source(preset, args.data, args.scale, args.seed, *flags)
    stages = source.stages(max(1, args.jobs), args.device, args.out)
    parsed = {name: _parsed(name, words) for name, words in stages.items()}  # what is wrong with them is said now
    check_out(args.out or source.bundle)
    told = {name: _call(name, each, args.json) for name, each in parsed.items()}
    if args.json:
        answer(args, "", data=args.data, preset=preset.name, scale=args.scale, stages=told)
    return 0


def _parsed(name: str, words: Words) -> argparse.Namespace:
    args = parser_of(name, _verb(name)).parse_all(words)
    settle(args)
    return args


def _call(name: str, args: argparse.Namespace, heard: bool) -> Any:
    """Run a stage, which prints its answer; or return it, where it is to be heard."""
    if not heard:
        return _verb(name).run(args)
    args.json = True
    with redirect_stdout(StringIO()) as said:
        _verb(name).run(args)
    return json.loads(said.getvalue())


def _verb(name: str) -> Any:
    return import_module(f"dreamfleet.worker.verbs.{name.replace('.', '_')}")
