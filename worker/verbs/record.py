"""`dreamfleet record`: drives as videos."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from dreamfleet.common.site import offer
from dreamfleet.common.stopping import Stop
from dreamfleet.worker.tools.videos import offer_videos, record_videos, videos_of

SUMMARY = "record drives as mp4s: the track, what the model sees, what it decodes, what it dreams"
EXTRAS = ("worker", "views")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--controller", required=True, help="a file, a run, one that ships, or a trained agent's file")
    offer_videos(parser)
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    parser.add_argument("--temperature", type=float, default=1.0, help="of the dream beside the drive (default 1.0)")
    offer(parser, "runs_dir")


def run(args: argparse.Namespace) -> int:
    """Record and print the scores."""
    videos = videos_of(args)
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.common.shelf import bundle_for, find_agent
    from dreamfleet.worker.dream.daydream import DaydreamConfig
    from dreamfleet.worker.scoring.agents import agent_of
    from dreamfleet.worker.tools.recording import record

    daydream = DaydreamConfig(args.temperature)
    controller, beside = find_agent(args.controller, args.runs_dir)
    agent = agent_of(controller, bundle_for(controller, args.bundle, beside))

    def film(seed: int, video: Path, move: Callable[[int], None], stop: Stop) -> float:
        return record(agent, seed, args.steps, video, replace(daydream, seed=seed), move, stop)

    return record_videos(args, videos, film)
