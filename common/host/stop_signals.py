"""Handling Ctrl-C and SIGTERM in long-running verbs: a clean stop, an interrupt, or a short delay. Pages: train.md."""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from dreamfleet.common.errors import StoppedError

SIGNALS = (signal.SIGINT, signal.SIGTERM)
END_LIMIT = 4.0  # seconds that an orderly end may take after the second signal (docs/how-to/monitor.md)
RETRY = 0.01  # seconds until a Ctrl-C that nobody could catch is sent again
Stop = Callable[[], bool]
"""Returns whether to stop at the next point where that is safe."""


def never_stop() -> bool:
    """A `Stop` that is always False."""
    return False


def stopping(report: Callable[[int], None], stop: Stop) -> Callable[[int], None]:
    """As `report`, which gets a count; but `StoppedError` once `stop` is true."""

    def check(count: int) -> None:
        if stop():
            raise StoppedError("stopped")
        report(count)

    return check


class Interrupts:
    """The handler that raises `KeyboardInterrupt`, and whether it did: an import may turn it into another error."""

    def __init__(self) -> None:
        self.seen = False

    def raise_one(self, _number: int, _frame: Any) -> None:
        """Handle a signal."""
        self.seen = True
        raise KeyboardInterrupt

    @contextmanager
    def on_ctrl_c(self) -> Iterator[None]:
        """Handle Ctrl-C, unless it is ignored; one that hits a finaliser, where nobody catches it, is raised again."""
        if (
            threading.current_thread() is not threading.main_thread()
            or signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        ):
            yield
            return
        self.seen = False
        before, report = signal.signal(signal.SIGINT, self.raise_one), sys.unraisablehook
        sys.unraisablehook = lambda lost: _interrupt_soon() if lost.exc_type is KeyboardInterrupt else report(lost)
        try:
            yield
        finally:
            sys.unraisablehook = report
            signal.signal(signal.SIGINT, before)


interrupts = Interrupts()


def _interrupt_soon() -> None:
    """Send Ctrl-C again once the main thread has left the finaliser."""
    again = threading.Timer(RETRY, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))
    again.daemon = True
    again.start()


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Yield a `Stop` that is True after a Ctrl-C or SIGTERM; a second raises `KeyboardInterrupt`. Main thread only."""
    stopped = False

    def handle(number: int, frame: Any) -> None:
        nonlocal stopped
        if stopped:
            interrupts.raise_one(number, frame)
        stopped = True

    with _handled_by(handle):
        yield lambda: stopped


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Make both Ctrl-C and SIGTERM raise `KeyboardInterrupt`, so that `finally` blocks run; main thread only.

    By default only Ctrl-C raises, and not in a script's background jobs, which shells start with SIGINT ignored.
    """
    with _handled_by(interrupts.raise_one):
        yield


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the end of a short operation that must not be torn."""
    if threading.current_thread() is not threading.main_thread():  # other threads receive no signals
        yield
        return
    waiting: list[int] = []
    with _handled_by(lambda number, _frame: waiting.append(number)):
        yield
    for received in waiting:
        signal.raise_signal(received)


@contextmanager
def _handled_by(handler: Callable[[int, Any], object]) -> Iterator[None]:
    with handlers_kept():
        for number in SIGNALS:
            signal.signal(number, handler)
        yield


@contextmanager
def handlers_kept() -> Iterator[None]:
    """Leave the handlers of Ctrl-C and SIGTERM as they were, whatever sets others inside."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():  # others set no handlers
            for number, handler in before.items():
                if handler is not None:  # of native code
                    signal.signal(number, handler)


def call_on_signals(stop: Callable[[], None]) -> None:
    """Call `stop` in a thread at each Ctrl-C or SIGTERM; the second ends this process within `END_LIMIT` seconds.

    The main thread may be blocked in native code, where Python handles no signal, so it has no part in this.
    """
    heard, sent = socket.socketpair()
    sent.setblocking(False)
    for number in SIGNALS:
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(sent.detach(), warn_on_full_buffer=False)

    def listen() -> None:
        received = 0
        while received < 2:
            if heard.recv(1)[0] in SIGNALS:
                received += 1
                if received == 2:
                    end_within(END_LIMIT, 1)  # docs/reference/protocol.md says five seconds
                stop()

    threading.Thread(target=listen, name="signals", daemon=True).start()


def end_within(seconds: float, code: int) -> None:
    """Let this process end with this exit code in so many seconds, if it has not ended before."""

    def end() -> None:
        time.sleep(seconds)
        os._exit(code)

    signal.alarm(round(seconds) + 1)  # the kernel ends the process, should Python be unable to run even a thread
    threading.Thread(target=end, name="end", daemon=True).start()


def outlive_stop_signals() -> None:
    """Do nothing on SIGINT and SIGTERM, which a service manager sends to all processes of a service.

    Processes that the simulator starts handle them as usual, so handlers are installed: ignored and blocked signals
    would be inherited.
    """

    def restore() -> None:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        unblock()

    # Blocked around a fork, so that a signal for the new process waits until that handles it.
    block = partial(signal.pthread_sigmask, signal.SIG_BLOCK, SIGNALS)
    unblock = partial(signal.pthread_sigmask, signal.SIG_UNBLOCK, SIGNALS)
    os.register_at_fork(before=block, after_in_parent=unblock, after_in_child=restore)
    for number in SIGNALS:
        signal.signal(number, lambda *_: None)
        signal.siginterrupt(number, False)
    unblock()
