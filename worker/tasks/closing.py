"""Closing an environment: its episodes are over, so a fault of its `close` is no longer theirs."""

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium

from dreamfleet.common.host.foreign_code import contained
from dreamfleet.common.printable import one_line

log = logging.getLogger(__name__)
MAX_TEXT = 300  # characters of a fault
CLOSE_LIMIT = 10.0  # seconds
_hung: dict[type, str] = {}  # classes of environments whose `close` hung in this process, and what was said of it
_leaves_open = False


def has_hung() -> bool:
    """Whether a `close` was interrupted in this process."""
    return bool(_hung)


def leave_open() -> None:
    """Close no environment in this process from now on, as another process has shown that this hangs."""
    global _leaves_open  # noqa: PLW0603 - of the process
    _leaves_open = True


class _Hung(BaseException):  # not an Exception, which an environment may catch
    """Interrupts a `close` that hangs."""


def close_environment(environment: gymnasium.Env[Any, Any]) -> str:
    """Close an environment; what its `close` raises is logged as a warning and returned, empty if it raises nothing.

    It is interrupted after `CLOSE_LIMIT` seconds, unless native code hangs or this is not the main thread. Other
    environments of that class are not closed any more.
    """
    kind = type(environment.unwrapped)
    if _leaves_open:
        return ""
    if kind in _hung:
        return _hung[kind]
    name, fault = kind.__name__, ""
    try:
        with contained(f"closing the environment {name}"), _limited(CLOSE_LIMIT):
            environment.close()
    except _Hung:
        fault = f"closing the environment {name} hangs: its close() was interrupted after {CLOSE_LIMIT:g} s"
        _hung[kind] = fault
    except (Exception, SystemExit) as error:  # environments may raise anything
        what = f"{type(error).__name__}: {one_line(str(error))[:MAX_TEXT]}"
        fault = f"closing the environment {name} failed, after it was used: {what}"
    if fault:
        log.warning("%s", fault)
    return fault


@contextmanager
def closing_environment(environment: gymnasium.Env[Any, Any]) -> Iterator[gymnasium.Env[Any, Any]]:
    """The environment, which is closed by `close_environment` when the `with` ends."""
    try:
        yield environment
    finally:
        close_environment(environment)


@contextmanager
def _limited(seconds: float) -> Iterator[None]:
    """Raise `_Hung` inside after this time, and again each second: a `close` may catch it."""
    if threading.current_thread() is not threading.main_thread():  # only that one is interrupted
        yield
        return

    def interrupt(*_: object) -> None:
        raise _Hung

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before or signal.SIG_DFL)
