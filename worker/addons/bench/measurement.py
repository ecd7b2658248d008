"""Measure a world model in a child process of one thread, and time calls in alternating blocks."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    pass

BLOCKS = 15
BLOCK_SECONDS = 0.15
TimedCall = Callable[[], Any]


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
