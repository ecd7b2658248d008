"""Ctrl-C and SIGTERM in a verb that works for long: the first ends it at a good place, the second at once."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

SIGNALS = (signal.SIGINT, signal.SIGTERM)
Stop = Callable[[], bool]
"""Whether to end at the next good place."""


def never_stop() -> bool:
    """Nobody asks to stop."""
    return False


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Inside, a first Ctrl-C or SIGTERM only makes what is yielded true; a second one raises `KeyboardInterrupt`.

    For the main thread, which alone may handle signals.
    """
    told = False

    def handle(_number: int, _frame: Any) -> None:
        nonlocal told
        if told:
            raise KeyboardInterrupt
        told = True

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield lambda: told
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Inside, Ctrl-C and SIGTERM raise `KeyboardInterrupt`, so that what was begun is ended on the way out.

    Python raises it only on Ctrl-C, and not where the process was started to ignore that, as a shell starts the
    background jobs of a script. For the main thread, which alone may handle signals.
    """
    before = {number: signal.signal(number, signal.default_int_handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Inside, Ctrl-C and SIGTERM wait: for what is short, and worth more whole than a moment earlier."""
    if threading.current_thread() is not threading.main_thread():  # where no signal is handled
        yield
        return
    waiting: list[int] = []
    before = {number: signal.signal(number, lambda told, _frame: waiting.append(told)) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    for told in waiting:
        signal.raise_signal(told)
