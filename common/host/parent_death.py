"""Child processes that end with their parent, also when it is killed; Ctrl-C is left to the parent.

`python -m dreamfleet.common.host.parent_death PARENT COMMAND` runs a command that ends so.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker

_PR_SET_PDEATHSIG = 1


@contextmanager
def signals_blocked() -> Iterator[None]:
    """A child started here inherits the mask: Ctrl-C, which reaches the whole group, cannot end it while it imports."""
    resource_tracker.ensure_running()  # as it starts it would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def exit_with_parent(parent: int) -> None:
    """Ask Linux to end this process with its parent; elsewhere it ends when it next looks at its pipe."""
    try:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    except (OSError, AttributeError):
        return
    if os.getppid() != parent:
        raise SystemExit(1)


def main() -> None:
    """Become the command."""
    exit_with_parent(int(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])  # noqa: S606 - our own interpreter and verb


if __name__ == "__main__":
    main()
