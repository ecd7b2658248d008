"""`dreamfleet live`: watch a candidate, the best mean, or any controller drive."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import TYPE_CHECKING

from dreamfleet.common.addons.frames.live import LiveView
from dreamfleet.common.cli.global_config import add_global_flags, add_run_argument, resolve_network
from dreamfleet.common.cli.output import add_json_flag, print_answer
from dreamfleet.common.client.client import Client
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.add_ons import add_on
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.printable import one_line, plural
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.lookup import find_bundle_of, find_evaluated_mean, naming_the_stored_run
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.worker.addons.evaluation.known_score import first_seed
from dreamfleet.worker.addons.evaluation.verb import add_random_flags, named_agent
from dreamfleet.worker.service.bundle_fetch import fetch_bundle_now, fetch_bundle_of

if TYPE_CHECKING:
    from dreamfleet.worker.addons.live.frame_sinks import SendFrame
    from dreamfleet.worker.addons.live.live_sources import Driver
    from dreamfleet.worker.addons.live.live_view import CaptionedFrame

SUMMARY = "watch what a worker scores, the best mean, or a controller: its drive, what it decodes, what it dreams"
EXTRAS = ("worker", "views")  # a window needs only the first
FIRST = "--connect --run --worker --best --controller --generation --seed --seconds --fps --out --temperature"
FASTEST = 50  # pictures a second
LONGEST = 20  # default seconds of pictures in files


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_global_flags(parser, "connect")
    add_run_argument(parser)
    whom = parser.add_mutually_exclusive_group()
    whom.add_argument("--worker", metavar="NAME", help="what this worker scores (default: the busiest worker's)")
    whom.add_argument("--best", action="store_true", help="drive the run's best mean so far here, seed after seed")
    whom.add_argument("--controller", help="who drives, without a live run: as `evaluate --controller`")
    add_random_flags(parser)
    parser.add_argument(
        "--generation", type=int, metavar="G", help="of the run that --controller names: the evaluated mean"
    )
    parser.add_argument("--fps", type=int, default=10, help="pictures per second (default 10)")
    parser.add_argument(
        "--seconds",
        type=float,
        help=f"end after so many seconds of pictures (default: {LONGEST} in files, else when you close it)",
    )
    parser.add_argument(
        "--seed", type=int,
        help=f"of --best and --controller: first seed (default a shipped controller's median one, else {TEST.start})",
    )  # fmt: skip
    parser.add_argument("--out", help="no window: an .mp4, a folder for PNGs, or - for a stream of JPEGs")
    parser.add_argument("--bundle", help="of --controller: the world model (default: the one that it names)")
    parser.add_argument("--temperature", type=float, default=1.0, help="of the dream (default 1.0)")
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Show until it is over, closed, or stopped."""
    _check(args)
    if args.out is not None:
        draw_unseen()

    with ExitStack() as stack:
        show = stack.enter_context(_open_sink(args))  # what cannot be shown is said before anything is asked
        pictures = stack.enter_context(_open_pictures(args))
        stop = stack.enter_context(stop_on_signals())
        seconds = LONGEST if args.seconds is None and _writes_files(args) else args.seconds
        most = None if seconds is None else max(1, round(seconds * args.fps))
        made = 0
        for shown in pictures:
            wanted = show(shown)
            made += shown is not None
            if not wanted or stop() or made == most:
                break
    if _writes_files(args):
        print_answer(args, f"{args.out}: {plural(made, 'picture')}", out=args.out, pictures=made)
    return 0


def _check(args: argparse.Namespace) -> None:
    some = args.seconds is None or (args.seconds > 0 and math.isfinite(args.seconds))
    if not 1 <= args.fps <= FASTEST or (args.seed or 0) < 0 or not some:
        raise UsageError(f"--fps must be 1 to {FASTEST}, --seconds above 0, --seed at least 0")
    if args.controller and args.run_name:
        raise UsageError("give either a live run to watch, or --controller, which needs none")
    if (args.task or args.environment) and (not args.controller or args.generation is not None):
        raise UsageError("--task and --environment are the world of --controller random")
    if args.generation is not None and not args.controller:
        raise UsageError("--generation needs a run on this disk: name it with --controller")


def _writes_files(args: argparse.Namespace) -> bool:
    """Whether pictures go into files, and so need not come in real time."""
    return args.out not in (None, "-")


def _open_sink(args: argparse.Namespace) -> AbstractContextManager[SendFrame]:
    if args.out is None:
        return _window(args.controller or args.run_name or "live")
    from dreamfleet.worker.addons.live.frame_sinks import open_sink

    return open_sink(args.out, args.fps, sys.stdout.buffer)


@contextmanager
def _window(name: str) -> Iterator[SendFrame]:
    with add_on("picture-window")(name) as screen:
        yield lambda shown: screen.draw(None if shown is None else shown.picture)


@contextmanager
def _open_pictures(args: argparse.Namespace) -> Iterator[Iterator[CaptionedFrame | None]]:
    if args.controller:
        yield _drive_pictures(args, _named_driver(args))
        return
    with naming_the_stored_run(args.runs_dir, args.run_name), Client(resolve_network(args)) as client:
        if args.best:
            name = args.run_name or client.status().run
            yield _drive_pictures(args, lambda: _best_driver(client, name))
        else:
            with _worker_pictures(args, client) as pictures:
                yield pictures


@contextmanager
def _worker_pictures(args: argparse.Namespace, client: Client) -> Iterator[Iterator[CaptionedFrame | None]]:
    """Pictures of what a worker of the run scores."""
    from dreamfleet.worker.addons.live.live_sources import worker_frames
    from dreamfleet.worker.addons.live.live_view import LiveCanvas, LiveDreamer

    with LiveView(client, args.run_name, args.worker) as view:
        spec = view.status.settings.task
        canvas = LiveCanvas(view.run, task=spec.task)
        if spec.bundle:
            bundle = fetch_bundle_now(client.session, view.run, spec.bundle)
            fitting, task = bundle.with_options(spec.controller, spec.options), bundle.manifest.task
            own = spec.task in (DREAM, task)  # actions of another task are not the world model's
            names, actions = (bundle.manifest.world.action_names, fitting.driving.controls) if own else ((), None)
            canvas = LiveCanvas(view.run, names, LiveDreamer(fitting, args.temperature), actions, task)
        print(f"watching run {view.run}; its workers: {view.status.workers.present}", file=sys.stderr)
        yield worker_frames(view, canvas, args.fps)
        if view.is_over:
            print(f"run {view.run} {view.status.state}: {one_line(view.status.why)}", file=sys.stderr)


def _drive_pictures(args: argparse.Namespace, driver: Callable[[], Driver]) -> Iterator[CaptionedFrame]:
    """A controller's drives: into files as fast as possible, elsewhere at `--fps`."""
    from dreamfleet.worker.addons.live.live_sources import driven_frames, limit_rate
    from dreamfleet.worker.addons.recording.parallel_dream import ParallelDreamConfig

    agent, _ = driver()
    known, word = agent.known_score, agent.world.score_word
    seed = args.seed if args.seed is not None else first_seed(known)
    if known is not None:
        print(f"first {word} {seed}{known.describe_beside(seed, word)}", file=sys.stderr)
    pictures = driven_frames(driver, ParallelDreamConfig(args.temperature), args.fps, seed)
    return pictures if _writes_files(args) else limit_rate(pictures, args.fps)


def _best_driver(client: Client, run: str) -> Driver:
    from dreamfleet.worker.addons.evaluation.agents import make_agent

    reported = client.controller(run)
    facts = {"run": run, "generation": reported.provenance.get("generation")}
    return make_agent(reported, fetch_bundle_of(reported, client.session, run)), facts


def _named_driver(args: argparse.Namespace) -> Callable[[], Driver]:
    from dreamfleet.worker.addons.evaluation.agents import make_agent

    if args.generation is not None:
        mean, folder = find_evaluated_mean(args.controller, args.runs_dir, args.generation)
        agent = make_agent(mean, find_bundle_of(mean, args.bundle, folder))
    else:
        agent = named_agent(args)
    facts = {"controller": args.controller, "generation": args.generation}
    return lambda: (agent, facts)
