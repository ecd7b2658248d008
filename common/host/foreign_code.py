"""Code of other packages in this process, such as a simulator that is made: what it changes here is undone."""

import logging
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from pathlib import Path

from dreamfleet.common.host.descendants import VARIABLE, Descendants
from dreamfleet.common.host.stop_signals import handlers_kept

log = logging.getLogger(__name__)
STDOUT, STDERR = 1, 2
SLOW = 30.0  # seconds


@contextmanager
def contained(what: str) -> Iterator[None]:
    """Run foreign code inside: it leaves the current folder, stdout, and handlers of Ctrl-C and SIGTERM as they were.

    What it prints goes to stderr: stdout is for a verb's answer. Processes that it starts end with this one, at the
    latest. After `SLOW` seconds a warning says `what` takes so long.
    """
    starting = nullcontext() if os.environ.get(VARIABLE) else Descendants().starting()  # another process may end them
    with _warning_if_slow(what), starting, answer_kept(), handlers_kept():  # docs/reference/tasks.md promises it
        yield


@contextmanager
def answer_kept() -> Iterator[None]:
    """Run foreign code inside, at length: it leaves the current folder as it was, and what it prints goes to stderr."""
    with _folder_kept(), _stdout_kept():
        yield


def send_stdout_to_stderr() -> None:
    """Let all that this process prints go to stderr, also what native code prints."""
    with suppress(OSError):
        os.dup2(STDERR, STDOUT)


@contextmanager
def _warning_if_slow(what: str) -> Iterator[None]:
    timer = threading.Timer(SLOW, log.warning, ("%s takes longer than %g s: wait, or press Ctrl-C", what, SLOW))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def _folder_kept() -> Iterator[None]:
    before = None
    with suppress(OSError):  # it may have been deleted
        before = Path.cwd()
    try:
        yield
    finally:
        if before is not None:
            os.chdir(before)


@contextmanager
def _stdout_kept() -> Iterator[None]:
    with suppress(OSError, ValueError, AttributeError):  # it may be closed, or none
        sys.stdout.flush()
    kept = None
    with suppress(OSError):
        kept = os.dup(STDOUT)
    try:
        with redirect_stdout(sys.stderr):
            send_stdout_to_stderr()
            yield
    finally:
        with suppress(OSError):  # foreign code may have closed it
            if kept is not None:
                os.dup2(kept, STDOUT)
                os.close(kept)
