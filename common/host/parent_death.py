"""Child processes that end with their parent, also on SIGKILL, and leave Ctrl-C to the parent.

`python -m dreamfleet.common.host.parent_death PARENT_PID COMMAND` runs a command that ends with the parent. Take Cover
runs this file alone, with `python -I -S`: it imports the standard library only.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from runpy import run_module

_PR_SET_PDEATHSIG = 1


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Block SIGINT and SIGTERM; children started inside inherit this, so Ctrl-C cannot end them during imports."""
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # its start would unblock the signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def exit_with_parent(parent: int) -> None:
    """Make Linux kill this process when its parent ends; on other systems, it ends when it next reads its pipe."""
    try:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    except (OSError, AttributeError):
        return
    if os.getppid() != parent:
        raise SystemExit(1)


def parent_death_command() -> tuple[str, ...]:
    """The prefix of a command that makes it end with this thread, also on SIGKILL; Linux only."""
    return (sys.executable, "-P", "-m", "dreamfleet.common.host.parent_death", str(os.getpid()))


def main() -> None:
    """Run the command in this process: a module in this interpreter, anything else in its place."""
    exit_with_parent(int(sys.argv[1]))
    command = sys.argv[2:]
    if command[:3] == [sys.executable, "-P", "-m"]:  # a second interpreter would start for nothing
        sys.argv[:] = command[3:]
        run_module(command[3], run_name="__main__", alter_sys=True)
    else:
        os.execv(command[0], command)  # noqa: S606 - a program of dreamfleet's choice


if __name__ == "__main__":
    main()
