"""`dreamfleet record`: drives as videos, one a seed."""

from __future__ import annotations

import argparse
import shlex
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.common.cli.progress import progress_bar
from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.files.atomic_write import check_output_path
from dreamfleet.common.host.packages import PACKAGES, check_modules
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.common.host.unseen_drawing import describe_choice, draw_unseen
from dreamfleet.common.printable import plural
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.common.worlds.score_words import profile_of
from dreamfleet.worker.addons.evaluation.known_score import first_seed
from dreamfleet.worker.addons.evaluation.verb import CONTROLLER, add_random_flags, agent_flags, named_agent

if TYPE_CHECKING:
    from dreamfleet.worker.addons.evaluation.agents import Agent
    from dreamfleet.worker.addons.recording.recording import Recorder

SUMMARY = "record drives as mp4s: the world, what the model sees, what it decodes, what it dreams"
EXTRAS = ("worker", "views")
MOST_STEPS = 1000  # a whole lap, and a whole game of the worlds that ship


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("--controller", required=True, help=CONTROLLER)
    add_random_flags(parser)
    parser.add_argument(
        "--seed", type=int, nargs="+", metavar="N",
        help=f"seed of the episode (default a median one of a shipped controller, else {TEST.start}); with several "
        "seeds there is one video each, drive-N.mp4",
    )  # fmt: skip
    parser.add_argument("--steps", type=int, default=MOST_STEPS, help=f"steps at most (default {MOST_STEPS})")
    parser.add_argument("--out", type=Path, default=Path("drive.mp4"), help="the video to write (default drive.mp4)")
    add_json_flag(parser)
    parser.add_argument("--bundle", help="the world model (default: the one that the controller names)")
    parser.add_argument("--temperature", type=float, default=1.0, help="of the dream beside the drive (default 1.0)")
    add_global_flags(parser, "runs_dir")


def run(args: argparse.Namespace) -> int:
    """Record, and print the scores."""
    video_paths(args, TEST.start)  # invalid arguments are refused before anything is loaded
    draw_unseen()
    from dreamfleet.worker.addons.recording.parallel_dream import ParallelDreamConfig
    from dreamfleet.worker.addons.recording.recording import record

    agent = named_agent(args)
    dreaming = ParallelDreamConfig(args.temperature)
    _record_videos(args, agent, partial(record, agent, steps=args.steps, dreaming=dreaming))
    if note := describe_choice():
        print(note, file=sys.stderr)
    print_next(args, ("evaluate", *agent_flags(args)))
    return 0


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
        raise UsageError(f"--out {out}: make its folder first: {shlex.join(('mkdir', '-p', str(folder)))}")
    for video in videos.values():
        check_output_path(video)
    return videos


def is_cut(driven: int, most: int, horizon: int) -> bool:
    """Whether a video of `most` steps at most ends before its drive, since fewer were asked for than one has."""
    return driven == most < min(horizon, MOST_STEPS)


def _record_videos(args: argparse.Namespace, agent: Agent, record_here: Recorder) -> None:
    """Record one video after another and print each score; Ctrl-C ends the current video and the verb."""
    from dreamfleet.worker.addons.recording.recording import record_in_process

    profile, known, world = profile_of(agent.reality), agent.known_score, agent.world
    check_modules(PACKAGES[each][0] for each in world.packages if each in PACKAGES)  # before a bar is drawn
    word, most = world.score_word, min(args.steps, world.horizon)
    with stop_on_signals() as stop:
        for seed, video in video_paths(args, first_seed(known)).items():
            replaces = video.exists()
            with progress_bar("record", most, "steps") as bar:
                score, driven = record_in_process(record_here, seed, video, bar.update, stop)
                bar.end(driven, "" if driven == most else "the episode ended")
            if stop():
                raise StoppedError(
                    f"stopped: {video} shows the first {plural(driven, 'step')} on {word} {seed}: "
                    f"{profile.format_score(score)}; the same command records whole episodes"
                )
            beside = "" if known is None else known.describe_beside(seed, word)
            if is_cut(driven, most, world.horizon):  # scores of whole episodes are no measure for it
                beside = f" in its first {plural(driven, 'step')} (--steps)"
            where = f"{video} (in place of an earlier one)" if replaces else f"{video}"
            text = f"{where}: {profile.format_score(score)} on {word} {seed}{beside}"
            print_answer(args, text, video=video, score=score, seed=seed, replaced=replaces)
