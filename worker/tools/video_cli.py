"""The arguments of `record`, and one video a seed."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.files.atomic_write import check_output_path
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.common.printable import format_number
from dreamfleet.common.runs.seeds import TEST

if TYPE_CHECKING:
    from dreamfleet.worker.tasks.api import World


def add_video_flags(parser: argparse.ArgumentParser) -> None:
    """Add the arguments about seeds, steps and files."""
    parser.add_argument(
        "--seed", type=int, nargs="+", default=[TEST.start], metavar="N",
        help=f"seed of the episode (default {TEST.start}); with several seeds there is one video each, drive-N.mp4",
    )  # fmt: skip
    parser.add_argument("--steps", type=int, default=1000, help="steps at most (default 1000)")
    parser.add_argument("--out", type=Path, default=Path("drive.mp4"), help="the video to write (default drive.mp4)")
    add_json_flag(parser)


def video_paths(args: argparse.Namespace) -> dict[int, Path]:
    """The video file of each seed; `UsageError` for invalid arguments."""
    out: Path = args.out
    if args.steps < 1 or min(args.seed) < 0:
        raise UsageError("--steps must be at least 1 and --seed at least 0")
    if out.suffix != ".mp4":
        raise UsageError(f"--out {out}: give a name that ends in .mp4")
    seeds = dict.fromkeys(args.seed)
    videos = {seed: out if len(seeds) == 1 else out.with_stem(f"{out.stem}-{seed}") for seed in seeds}
    for video in videos.values():
        check_output_path(video)
    return videos


def record_videos(args: argparse.Namespace, videos: dict[int, Path], film: partial[float], world: World) -> int:
    """Record one video after another and print each score; Ctrl-C ends the current video and the verb.

    `film` is as in `record_in_process`.
    """
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.tools.recording import record_in_process

    word, most = world.score_word, min(args.steps, world.horizon)
    with stop_on_signals() as stop:
        for seed, video in videos.items():
            with progress_bar("record", most, "steps") as bar:
                score, driven = record_in_process(film, seed, video, bar.update, stop)
            if stop():
                raise StoppedError(
                    f"stopped: {video} shows the first {driven} steps on {word} {seed}, with a score of "
                    f"{format_number(score)}; the same command records whole episodes"
                )
            text = f"{video}: score {format_number(score)} on {word} {seed}"
            print_answer(args, text, video=video, score=score, seed=seed)
    return 0
