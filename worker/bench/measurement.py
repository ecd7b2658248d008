"""Measure a world model in a child process of one thread, and time calls in alternating blocks."""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dreamfleet.common.artifacts.bundle import Bundle

BLOCKS = 15
BLOCK_SECONDS = 0.15
TimedCall = Callable[[], Any]


def add_bundle_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of a verb that measures a world model."""
    parser.add_argument("--bundle", default="tiny", help="the world model (default tiny)")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def print_figures(measure: Callable[[Bundle], dict[str, Any]], args: argparse.Namespace) -> int:
    """Measure the bundle that `args` name in a child process, and print the figures."""
    from multiprocessing import get_context

    from dreamfleet.common.artifacts.bundle_store import find_bundle
    from dreamfleet.common.host.resource_limits import clear_library_settings, pin_thread_pools

    bundle = find_bundle(args.bundle)
    clear_library_settings()
    pin_thread_pools()
    # In a child: NumPy's library reads its thread count as it loads, and this process has loaded it.
    with get_context("spawn").Pool(1) as pool:
        figures = pool.apply(measure, (bundle,))
    if args.json:
        print(json.dumps(figures))  # noqa: T201 - a verb's output
    else:
        for name, value in figures.items():
            print(f"{name:>22}  {value}")  # noqa: T201 - as above
    return 0


def time_alternately(cases: dict[str, TimedCall]) -> dict[str, float]:
    """Seconds per call of each case: the median over alternating blocks, so that a slow phase hits all alike."""
    counts = {name: _count_calls_per_block(call) for name, call in cases.items()}
    blocks: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(BLOCKS):
        for name, call in cases.items():
            started = perf_counter()
            for _ in range(counts[name]):
                call()
            blocks[name].append((perf_counter() - started) / counts[name])
    return {name: statistics.median(values) for name, values in blocks.items()}


def _count_calls_per_block(call: TimedCall) -> int:
    call()
    started, calls = perf_counter(), 0
    while perf_counter() - started < BLOCK_SECONDS:
        call()
        calls += 1
    return calls
