"""`dreamfleet record`: drives as videos."""

from __future__ import annotations

import argparse
import sys
from functools import partial

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import print_next
from dreamfleet.common.host.unseen_drawing import describe_choice, draw_unseen
from dreamfleet.worker.addons.evaluation.verb import CONTROLLER, add_random_flags, agent_flags, named_agent
from dreamfleet.worker.addons.recording.video_cli import add_video_flags, check_video_flags, record_videos

SUMMARY = "record drives as mp4s: the world, what the model sees, what it decodes, what it dreams"
EXTRAS = ("worker", "views")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--controller", required=True, help=CONTROLLER)
    add_random_flags(parser)
    add_video_flags(parser)
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    parser.add_argument("--temperature", type=float, default=1.0, help="of the dream beside the drive (default 1.0)")
    add_global_flags(parser, "runs_dir")


def run(args: argparse.Namespace) -> int:
    """Record, and print the scores."""
    check_video_flags(args)
    draw_unseen()
    from dreamfleet.worker.addons.recording.parallel_dream import ParallelDreamConfig
    from dreamfleet.worker.addons.recording.recording import record

    agent = named_agent(args)
    film = partial(record, agent, steps=args.steps, dreaming=ParallelDreamConfig(args.temperature))
    code = record_videos(args, agent, film)
    if note := describe_choice():
        print(note, file=sys.stderr)
    print_next(args, ("evaluate", *agent_flags(args)))
    return code
