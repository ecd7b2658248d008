"""Time calls in alternating blocks."""

import socket
import statistics
from collections.abc import Callable, Hashable
from time import perf_counter
from typing import Any, TypeVar

BLOCKS = 15
BLOCK_SECONDS = 0.15
TimedCall = Callable[[], Any]
Case = TypeVar("Case", bound=Hashable)


def time_alternately(cases: dict[Case, TimedCall]) -> dict[Case, float]:
    """Seconds per call of each case: the median over alternating blocks, so that a slow phase hits all alike."""
    counts = {name: _count_calls_per_block(call) for name, call in cases.items()}
    blocks: dict[Case, list[float]] = {name: [] for name in cases}
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


def free_endpoint() -> str:
    """An endpoint on this host that nobody listens on."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"
