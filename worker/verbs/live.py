"""`dreamfleet live`: watch a candidate, the best mean, or any controller drive."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import TYPE_CHECKING

from dreamfleet.common.errors import UsageError
from dreamfleet.common.listing import add_json, answer
from dreamfleet.common.printable import one_line
from dreamfleet.common.seeds import TEST
from dreamfleet.common.site import offer, offer_run, reached

if TYPE_CHECKING:
    from dreamfleet.common.bundle import Bundle
    from dreamfleet.common.client import Client
    from dreamfleet.common.messages import TaskSpec
    from dreamfleet.worker.tools.glass import Shown
    from dreamfleet.worker.tools.live import Driver
    from dreamfleet.worker.tools.outlets import Show

SUMMARY = "watch what a worker scores, the best mean, or a controller: its drive, what it decodes, what it dreams"
EXTRAS = ("worker", "views")  # a window needs only the first
FASTEST = 50  # pictures a second
LONGEST = 20  # seconds of pictures in files, unless told otherwise


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    offer(parser, "connect")
    offer_run(parser)
    whom = parser.add_mutually_exclusive_group()
    whom.add_argument("--worker", metavar="NAME", help="what this worker scores (default: the busiest worker's)")
    whom.add_argument("--best", action="store_true", help="the run's best mean so far, driven here track after track")
    whom.add_argument(
        "--controller", help="no run: a file, a run on this disk, one that ships, or a trained agent's file"
    )
    parser.add_argument(
        "--generation", type=int, metavar="G", help="of the run that --controller names: the evaluated mean"
    )
    parser.add_argument("--fps", type=int, default=10, help="pictures a second (default 10)")
    parser.add_argument(
        "--seconds",
        type=float,
        help=f"end after so many seconds of pictures (default: {LONGEST} in files, else when you close it)",
    )
    parser.add_argument(
        "--seed", type=int, default=TEST.start, help=f"of --best and --controller: first track (default {TEST.start})"
    )
    parser.add_argument("--out", help="no window: an .mp4, a folder for PNGs, or - for a stream of JPEGs")
    parser.add_argument("--bundle", help="of --controller: the world model (default: the one that it names)")
    parser.add_argument("--temperature", type=float, default=1.0, help="of the dream (default 1.0)")
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Show until it is over, closed, or told to stop."""
    _check(args)
    os.environ["PYGAME_HIDE_SUPPORT_PROMPT"] = "1"  # a greeting on stdout, where a stream may go
    if args.out is not None:
        os.environ["SDL_VIDEODRIVER"] = "dummy"
    from dreamfleet.common.stopping import heeding_signals

    with ExitStack() as stack:
        show = stack.enter_context(_outlet(args))  # what cannot be shown is said before anything is asked
        pictures = stack.enter_context(_pictures(args))
        stop = stack.enter_context(heeding_signals())
        seconds = LONGEST if args.seconds is None and _in_files(args) else args.seconds
        most = None if seconds is None else max(1, round(seconds * args.fps))
        made = 0
        for shown in pictures:
            wanted = show(shown)
            made += shown is not None
            if not wanted or stop() or made == most:
                break
    if _in_files(args):
        answer(args, f"{args.out}: {made} pictures", out=args.out, pictures=made)
    return 0


def _check(args: argparse.Namespace) -> None:
    some = args.seconds is None or (args.seconds > 0 and math.isfinite(args.seconds))
    if not 1 <= args.fps <= FASTEST or args.seed < 0 or not some:
        raise UsageError(f"--fps must be 1 to {FASTEST}, --seconds above 0, --seed at least 0")
    if args.controller and args.run_name:
        raise UsageError("give either a live run to watch, or --controller, which needs none")
    if args.generation is not None and not args.controller:
        raise UsageError("--generation is of a run on this disk: name it with --controller")


def _in_files(args: argparse.Namespace) -> bool:
    """Whether nobody looks while it runs."""
    return args.out not in (None, "-")


def _outlet(args: argparse.Namespace) -> AbstractContextManager[Show]:
    if args.out is None:
        return _window(args.controller or args.run_name or "live")
    from dreamfleet.worker.tools.outlets import outlet

    return outlet(args.out, args.fps, sys.stdout.buffer)


@contextmanager
def _window(name: str) -> Iterator[Show]:
    from dreamfleet.worker.driving.screen import Screen

    with Screen(name) as screen:
        yield lambda shown: screen.draw(None if shown is None else shown.picture)


@contextmanager
def _pictures(args: argparse.Namespace) -> Iterator[Iterator[Shown | None]]:
    from dreamfleet.common.client import Client

    if args.controller:
        yield _drives(args, _found(args))
        return
    with Client(reached(args)) as client:
        if args.best:
            name = args.run_name or client.status().run
            yield _drives(args, lambda: _best(client, name))
        else:
            with _watched(args, client) as pictures:
                yield pictures


@contextmanager
def _watched(args: argparse.Namespace, client: Client) -> Iterator[Iterator[Shown | None]]:
    """What a worker of the run does."""
    from dreamfleet.common.codec import Inbox
    from dreamfleet.common.live import LiveView
    from dreamfleet.common.store import BundleStore, default_cache
    from dreamfleet.common.variants import Variant
    from dreamfleet.worker.service.bundle_fetch import obtain
    from dreamfleet.worker.tools.glass import Glass, Imagination
    from dreamfleet.worker.tools.live import watched

    with LiveView(client, args.run_name, args.worker) as view:
        spec = view.status.settings.task
        glass = Glass(view.run)
        if spec.bundle:
            bundle = obtain(client.session, view.run, spec.bundle, BundleStore(default_cache()), Inbox())
            assert bundle is not None  # nobody stops it
            fitting = bundle.under(spec.controller, Variant.of(spec.options))
            glass = Glass(view.run, _action_names(spec, fitting), Imagination(fitting, args.temperature))
        print(f"watching run {view.run}; its workers: {view.status.workers.present}", file=sys.stderr)
        yield watched(view, glass, args.fps)
        if view.over:
            print(f"run {view.run} {view.status.state}: {one_line(view.status.why)}", file=sys.stderr)


def _action_names(spec: TaskSpec, bundle: Bundle) -> tuple[str, ...]:
    """As the world has them; a task's name is code, so one that is not registered here is not asked."""
    from dreamfleet.worker.tasks.api import Assignment
    from dreamfleet.worker.tasks.registry import find_task, known_tasks

    known = {spec.task, bundle.manifest.task} <= set(known_tasks())
    return find_task(spec.task).world_of(Assignment(spec, bundle)).action_names if known else ()


def _drives(args: argparse.Namespace, driver: Callable[[], Driver]) -> Iterator[Shown]:
    """A controller's drives; in a file as fast as they can be made, elsewhere at the world's pace."""
    from dreamfleet.worker.dream.daydream import DaydreamConfig
    from dreamfleet.worker.tools.live import driven, paced

    pictures = driven(driver, DaydreamConfig(args.temperature), args.fps, args.seed)
    return pictures if _in_files(args) else paced(pictures, args.fps)


def _best(client: Client, run: str) -> Driver:
    """The run's best mean as it is now."""
    from dreamfleet.worker.scoring.agents import agent_of
    from dreamfleet.worker.service.bundle_fetch import fetch_for

    reported = client.controller(run)
    facts = {"run": run, "generation": reported.provenance.get("generation")}
    return agent_of(reported, fetch_for(reported, client.session, run)), facts


def _found(args: argparse.Namespace) -> Callable[[], Driver]:
    """Whom `--controller` names."""
    from dreamfleet.common.shelf import bundle_for, find_agent, find_mean
    from dreamfleet.worker.scoring.agents import agent_of

    if args.generation is not None:
        mean, folder = find_mean(args.controller, args.runs_dir, args.generation)
        agent = agent_of(mean, bundle_for(mean, args.bundle, folder))
    else:
        controller, beside = find_agent(args.controller, args.runs_dir)
        agent = agent_of(controller, bundle_for(controller, args.bundle, beside))
    facts = {"controller": args.controller, "generation": args.generation}
    return lambda: (agent, facts)
