"""`dreamfleet lab bench PART`: how fast the parts are."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from operator import call
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.output import add_json_flag
from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.host.resource_limits import clear_library_settings, pin_thread_pools

if TYPE_CHECKING:
    from dreamfleet.common.artifacts.bundle import Bundle

SUMMARY = "measure how fast a part is: policy, dream, env, live, dispatch or batches"
EXTRAS = ("worker",)
BUNDLE, EPISODES = "tiny", 3
Figures = dict[str, Any]


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    texts = ". ".join(f"`{name}`: {part.text}" for name, part in PARTS.items())
    parser.add_argument("part", metavar="PART", choices=tuple(PARTS), help=texts)
    parser.add_argument("--bundle", help=f"the world model of policy, dream, env and live (default {BUNDLE})")
    parser.add_argument(
        "--workers", type=int, metavar="N", help="of dispatch: let N simulated workers join and work too"
    )
    parser.add_argument("--episodes", type=int, metavar="N", help=f"of env: episodes of each kind (default {EPISODES})")
    parser.add_argument(
        "--exact", action="store_true", default=None,
        help="of env: compare with gymnasium's over whole episodes instead, which takes about ten minutes",
    )  # fmt: skip
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Measure the part, and print the figures."""
    part = PARTS[args.part]
    given = [name for name in ("bundle", "workers", "episodes", "exact") if getattr(args, name) is not None]
    if foreign := [name for name in given if name not in part.flags]:
        raise UsageError(f"--{foreign[0]} is of {', '.join(n for n, p in PARTS.items() if foreign[0] in p.flags)}")
    args.bundle = args.bundle or BUNDLE
    figures = part.measure(args)
    if args.json:
        print(json.dumps(figures))
    elif not args.exact:  # which prints each comparison
        for name, value in figures.items():
            print(f"{name:>22}  {value}")
    return 0 if figures.get("exact", True) else 1


def _measure_policy(args: argparse.Namespace) -> Figures:
    from dreamfleet.worker.addons.bench.steps import bench_policy

    return measure_on_one_thread(bench_policy, args.bundle)


def _measure_dream(args: argparse.Namespace) -> Figures:
    from dreamfleet.worker.addons.bench.steps import bench_dream

    return measure_on_one_thread(bench_dream, args.bundle)


def _measure_dispatch(args: argparse.Namespace) -> Figures:
    from dreamfleet.worker.addons.bench.dispatch import bench_dispatch

    return bench_dispatch(max(0, args.workers or 0))


def _measure_batches(_args: argparse.Namespace) -> Figures:
    from dreamfleet.worker.addons.bench.batches import bench_batches

    return bench_batches()


def _measure_live(args: argparse.Namespace) -> Figures:
    pin_thread_pools()
    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.worker.addons.bench.live import bench_live

    return bench_live(find_bundle(args.bundle))


def _measure_env(args: argparse.Namespace) -> Figures:
    if args.exact:
        return _compare(args.bundle)
    from dreamfleet.worker.addons.bench.environment import bench_env

    rounds = max(1, EPISODES if args.episodes is None else args.episodes)
    return measure_on_one_thread(bench_env, args.bundle, rounds)


def _compare(bundle_name: str) -> Figures:
    """Compare the environment with gymnasium's, and print each comparison on stderr."""
    from dreamfleet.common.artifacts.bundle_store import find_bundle

    bundle = find_bundle(bundle_name)
    _pin_libraries()
    from dreamfleet.worker.addons.bench.environment import check_exact

    differences, compared = 0, []
    for what, difference in check_exact(bundle):
        differences += difference is not None
        compared.append(what)
        outcome = "the same" if difference is None else f"DIFFERS at step {difference.step}: {difference.what}"
        print(f"{what}: {outcome}", file=sys.stderr)
    return {"exact": not differences, "compared": compared, "differences": differences}


def measure_on_one_thread(measure: Callable[..., Figures], bundle_name: str, *more: object) -> Figures:
    """The figures of `measure(bundle, *more)`, called in a child process whose libraries use one thread."""
    from concurrent.futures.process import BrokenProcessPool

    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.host.process_pool import map_in_processes

    bundle: Bundle = find_bundle(bundle_name)
    _pin_libraries()
    # A child: numpy's library reads its thread count once, when loaded, and this process has loaded it.
    try:
        (figures,) = map_in_processes(1, pin_thread_pools, (), call, [partial(measure, bundle, *more)])
    except BrokenProcessPool as error:
        raise DreamfleetError("the process that measured has crashed; is memory short?") from error
    return figures


def _pin_libraries() -> None:
    clear_library_settings()
    pin_thread_pools()


@dataclass(frozen=True)
class Part:
    """A part that can be measured: what about it, by which function, and the flags that it takes.

    `exact` among its figures says whether it passed.
    """

    text: str
    measure: Callable[[argparse.Namespace], Figures]
    flags: tuple[str, ...] = ("bundle",)


PARTS = {
    "policy": Part("a policy step, against this core's matrix rate and against torch", _measure_policy),
    "dream": Part("dreamed steps a second, against their matrix products alone and against torch", _measure_dream),
    "env": Part("the environment against gymnasium's own", _measure_env, ("bundle", "episodes", "exact")),
    "live": Part("what the live view costs a slot, unwatched and watched", _measure_live),
    "dispatch": Part("jobs a second through real Zenoh, beside Dask and Ray where installed", _measure_dispatch,
                     ("workers",)),
    "batches": Part("evaluations a second that a search elsewhere reaches, over Zenoh and over HTTP",
                     _measure_batches),
}  # fmt: skip
