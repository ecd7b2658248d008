"""`dreamfleet baseline record`: a baseline's drives as videos."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path

from dreamfleet.common.host.stop_signals import Stop
from dreamfleet.worker.tools.video_cli import add_video_flags, record_videos, video_paths

SUMMARY = "record a baseline's drives as mp4s"
EXTRAS = ("worker", "views")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    from dreamfleet.worker.baselines.presets import NAMES

    parser.add_argument("agent", choices=NAMES, help="who drives")
    parser.add_argument("--data", type=Path, help="of drqn: the folder of its training")
    add_video_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Record and print the scores."""
    videos = video_paths(args)
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.worker.baselines.agents import find_baseline
    from dreamfleet.worker.tools.recording import record

    agent = find_baseline(args.agent, args.data)

    def film(seed: int, video: Path, move: Callable[[int], None], stop: Stop) -> float:
        return record(agent, seed, args.steps, video, on_step=move, stop=stop)

    return record_videos(args, videos, film)
