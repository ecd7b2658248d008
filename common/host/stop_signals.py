"""Handling Ctrl-C and SIGTERM in long-running verbs: a clean stop, an interrupt, or a short delay."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
Stop = Callable[[], bool]
"""Returns whether to stop at the next point where that is safe."""


def never_stop() -> bool:
    """A `Stop` that is always False."""
    return False


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Yield a `Stop` that is True after a first Ctrl-C or SIGTERM; a second one raises `KeyboardInterrupt`.

    Main thread only: other threads cannot handle signals.
    """
    stopped = False

    def handle(_number: int, _frame: Any) -> None:
        nonlocal stopped
        if stopped:
            raise KeyboardInterrupt
        stopped = True

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield lambda: stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Make both Ctrl-C and SIGTERM raise `KeyboardInterrupt`, so that `finally` blocks run.

    By default only Ctrl-C raises, and not in a script's background jobs, which shells start with SIGINT ignored. Main
    thread only.
    """
    before = {number: signal.signal(number, signal.default_int_handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the end of a short operation that must not be torn."""
    if threading.current_thread() is not threading.main_thread():  # other threads receive no signals
        yield
        return
    waiting: list[int] = []
    before = {number: signal.signal(number, lambda number, _frame: waiting.append(number)) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    for received in waiting:
        signal.raise_signal(received)
