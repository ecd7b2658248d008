"""`dreamfleet bench policy|dream|dispatch|live|env`: how fast the parts are."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.command_line import SimpleVerb

if TYPE_CHECKING:
    from dreamfleet.common.artifacts.bundle import Bundle

EXTRAS = ("worker",)


def configure_bundle(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a benchmark of one world model."""
    parser.add_argument("--bundle", default="tiny", help="the world model (default tiny)")
    _add_json_flag(parser)


def measure_policy(args: argparse.Namespace) -> int:
    """Measure a policy step on one thread."""
    from dreamfleet.worker.bench.policy import bench_policy

    return _print_figures(args, measure_on_one_thread(bench_policy, args.bundle))


def measure_dream(args: argparse.Namespace) -> int:
    """Measure dreamed steps on one thread."""
    from dreamfleet.worker.bench.dream import bench_dream

    return _print_figures(args, measure_on_one_thread(bench_dream, args.bundle))


def configure_dispatch(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `bench dispatch`."""
    parser.add_argument(
        "--workers", type=int, default=0, metavar="N", help="also let N simulated workers join and work"
    )
    _add_json_flag(parser)


def measure_dispatch(args: argparse.Namespace) -> int:
    """Measure how fast a coordinator dispatches."""
    from dreamfleet.worker.bench.dispatch import bench_dispatch

    return _print_figures(args, bench_dispatch(max(0, args.workers)))


def measure_live(args: argparse.Namespace) -> int:
    """Measure what the live view costs each task."""
    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.host.resource_limits import pin_thread_pools

    pin_thread_pools()
    from dreamfleet.worker.bench.live import bench_live

    return _print_figures(args, bench_live(find_bundle(args.bundle)))


def configure_env(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `bench env`."""
    parser.add_argument("--bundle", default="tiny", help="the world model of the fitness step (default tiny)")
    parser.add_argument("--episodes", type=int, default=3, help="whole episodes of each kind (default 3)")
    parser.add_argument("--exact", action="store_true", help="compare instead of measuring: about ten minutes")
    _add_json_flag(parser)


def measure_env(args: argparse.Namespace) -> int:
    """Measure the environment on one thread, or compare it with gymnasium's; exit 1 if anything differs."""
    if args.exact:
        return _compare(args)
    from dreamfleet.worker.bench.environment import bench_env

    figures = measure_on_one_thread(bench_env, args.bundle, max(1, args.episodes))
    _print_figures(args, figures)
    return 0 if figures["exact"] else 1


def _compare(args: argparse.Namespace) -> int:
    from dreamfleet.common.artifacts.bundle_store import find_bundle

    bundle = find_bundle(args.bundle)
    _pin_libraries()
    from dreamfleet.worker.bench.environment import check_exact

    differences, compared = 0, []
    for what, difference in check_exact(bundle):
        differences += difference is not None
        compared.append(what)
        outcome = "the same" if difference is None else f"DIFFERS at step {difference.step}: {difference.what}"
        print(f"{what}: {outcome}", file=sys.stderr)
    if args.json:
        print(json.dumps({"exact": not differences, "compared": compared, "differences": differences}))
    return 1 if differences else 0


def measure_on_one_thread(measure: Callable[..., dict[str, Any]], bundle_name: str, *more: object) -> dict[str, Any]:
    """The figures of `measure(bundle, *more)`, called in a child process whose libraries use one thread."""
    from concurrent.futures import ProcessPoolExecutor
    from concurrent.futures.process import BrokenProcessPool
    from multiprocessing import get_context

    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.errors import DreamfleetError
    from dreamfleet.common.host.parent_death import end_on_signals, signals_blocked

    bundle: Bundle = find_bundle(bundle_name)
    _pin_libraries()
    # A child: numpy's library reads its thread count once, when loaded, and this process has loaded it.
    with ProcessPoolExecutor(1, get_context("spawn"), end_on_signals) as pool:
        try:
            with signals_blocked():
                measured = pool.submit(measure, bundle, *more)
            return measured.result()
        except BrokenProcessPool as error:
            raise DreamfleetError("the process that measured has crashed; is memory short?") from error


def _pin_libraries() -> None:
    from dreamfleet.common.host.resource_limits import clear_library_settings, pin_thread_pools

    clear_library_settings()
    pin_thread_pools()


def _add_json_flag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def _print_figures(args: argparse.Namespace, figures: Mapping[str, Any]) -> int:
    if args.json:
        print(json.dumps(figures))
    else:
        for name, value in figures.items():
            print(f"{name:>22}  {value}")
    return 0


POLICY = SimpleVerb(
    "measure a policy step against this core's matrix rate and against torch", configure_bundle, measure_policy, EXTRAS
)
DREAM = SimpleVerb(
    "measure dreamed steps a second, against their matrix products alone and against torch",
    configure_bundle,
    measure_dream,
    EXTRAS,
)
DISPATCH = SimpleVerb(
    "measure dispatch through real Zenoh: 50 ms jobs, null jobs, many workers; peers where installed",
    configure_dispatch,
    measure_dispatch,
    EXTRAS,
)
LIVE = SimpleVerb(
    "measure what the live view costs a slot: unwatched, and watched", configure_bundle, measure_live, EXTRAS
)
ENV = SimpleVerb(
    "measure the environment against gymnasium's own; --exact proves the two equal over whole episodes",
    configure_env,
    measure_env,
    EXTRAS,
)
