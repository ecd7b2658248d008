"""`dreamfleet drive`: drive yourself."""

import argparse
from secrets import randbelow

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import format_number, plural

SUMMARY = "drive yourself by keyboard, on the track or in a world model's dream"
EXTRAS = ("worker",)
BUNDLE, TEMPERATURE = "tiny", 1.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--dream", action="store_true", help="drive in the dream instead of on the track")
    parser.add_argument("--bundle", help=f"the world model that dreams: a file, or one that ships (default {BUNDLE})")
    parser.add_argument("--temperature", type=float, help=f"of the dream (default {TEMPERATURE})")
    parser.add_argument("--seed", type=int, help="the track, or the dream (default a new one each time)")
    parser.add_argument("--steps", type=int, default=1000, help="steps until it ends (default 1000)")
    parser.add_argument(
        "--scale", type=float, help="enlarge the picture (default: a dream to 640 pixels, the track not at all)"
    )
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Drive, and print each episode's score."""
    if not args.dream and (args.bundle is not None or args.temperature is not None):
        raise UsageError("--bundle and --temperature need a dream: add --dream")
    from dreamfleet.worker.addons.driving.loop import DreamScene, DrivingConfig, Scene, drive, make_scene

    config = DrivingConfig(randbelow(10_000) if args.seed is None else args.seed, args.steps, args.scale)
    scene: Scene
    if args.dream:
        temperature = TEMPERATURE if args.temperature is None else args.temperature
        scene = DreamScene(find_bundle(args.bundle or BUNDLE), temperature, config.steps)
    else:
        scene = make_scene(FIRST_WORLD, config.steps)
    for driven in drive(scene, config):
        text = f"score {format_number(driven.score)} in {plural(driven.steps, 'step')}, seed {config.seed}"
        print_answer(args, text, score=driven.score, steps=driven.steps, seed=config.seed)
    return 0
