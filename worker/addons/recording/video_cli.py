"""The arguments of `record`, and one video a seed."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.files.atomic_write import check_output_path
from dreamfleet.common.host.packages import PACKAGES, check_modules
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.common.printable import plural
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.common.worlds.score_words import profile_of

if TYPE_CHECKING:
    from dreamfleet.worker.addons.evaluation.agents import Agent

MOST_STEPS = 1000  # a whole lap, and a whole game of the worlds that ship


def add_video_flags(parser: argparse.ArgumentParser) -> None:
    """Add the arguments about seeds, steps and files."""
    parser.add_argument(
        "--seed", type=int, nargs="+", metavar="N",
        help=f"seed of the episode (default a median one of a shipped controller, else {TEST.start}); with several "
        "seeds there is one video each, drive-N.mp4",
    )  # fmt: skip
    parser.add_argument("--steps", type=int, default=MOST_STEPS, help=f"steps at most (default {MOST_STEPS})")
    parser.add_argument("--out", type=Path, default=Path("drive.mp4"), help="the video to write (default drive.mp4)")
    add_json_flag(parser)


def check_video_flags(args: argparse.Namespace) -> None:
    """`UsageError` for invalid arguments, before anything is loaded."""
    video_paths(args, TEST.start)


def video_paths(args: argparse.Namespace, default_seed: int) -> dict[int, Path]:
    """The video file of each seed; `UsageError` for invalid arguments."""
    out: Path = args.out
    given = args.seed or [default_seed]
    if args.steps < 1 or min(given) < 0:
        raise UsageError("--steps must be at least 1 and --seed at least 0")
    if out.suffix != ".mp4":
        raise UsageError(f"--out {out}: give a name that ends in .mp4")
    seeds = dict.fromkeys(given)
    videos = {seed: out if len(seeds) == 1 else out.with_stem(f"{out.stem}-{seed}") for seed in seeds}
    folder = out.parent.resolve()
    if not folder.exists() and not folder.is_relative_to(Path.cwd().resolve()):  # it may be misspelt
        raise UsageError(f"--out {out}: make its folder first: mkdir -p {folder}")
    for video in videos.values():
        check_output_path(video)
    return videos


def record_videos(args: argparse.Namespace, agent: Agent, film: partial[float]) -> int:
    """Record one video after another and print each score; Ctrl-C ends the current video and the verb.

    `film` is as in `record_in_process`.
    """
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.addons.evaluation.known_score import first_seed
    from dreamfleet.worker.addons.recording.recording import record_in_process

    profile, known, world = profile_of(agent.reality), agent.known_score, agent.world
    check_modules(PACKAGES[each][0] for each in world.packages if each in PACKAGES)  # before a bar is drawn
    word, most = world.score_word, min(args.steps, world.horizon)
    with stop_on_signals() as stop:
        for seed, video in video_paths(args, first_seed(known)).items():
            with progress_bar("record", most, "steps") as bar:
                score, driven = record_in_process(film, seed, video, bar.update, stop)
                bar.end(driven, "" if driven == most else "the episode ended")
            if stop():
                raise StoppedError(
                    f"stopped: {video} shows the first {plural(driven, 'step')} on {word} {seed}: "
                    f"{profile.format_score(score)}; the same command records whole episodes"
                )
            beside = "" if known is None else known.describe_beside(seed, word)
            if driven == most < min(world.horizon, MOST_STEPS):  # scores of whole episodes are no measure for it
                beside = f" in its first {plural(driven, 'step')} (--steps)"
            text = f"{video}: {profile.format_score(score)} on {word} {seed}{beside}"
            print_answer(args, text, video=video, score=score, seed=seed)
    return 0
