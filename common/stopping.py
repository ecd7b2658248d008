"""Ctrl-C and SIGTERM in a verb that works for long: the first ends it at a good place, the second at once."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

Stop = Callable[[], bool]
"""Whether to end at the next good place."""


def never() -> bool:
    """Nobody asks to stop."""
    return False


@contextmanager
def heeding_signals() -> Iterator[Stop]:
    """Inside, a first Ctrl-C or SIGTERM only makes what is yielded true; a second one raises `KeyboardInterrupt`.

    For the main thread, which alone may handle signals.
    """
    told = False

    def handle(_number: int, _frame: Any) -> None:
        nonlocal told
        if told:
            raise KeyboardInterrupt
        told = True

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: told
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
