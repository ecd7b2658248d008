"""Ending what child processes leave behind: a simulator's own processes outlive a crash, and hold pipes open.

A descendant is found by the child's process session or by a mark in the environment that it inherited. So it is found
too if it left the session or lost its parent. Not found is one that left the session and also cleared its environment.
As a script, this file is the guard: when the process that started it ends, also by SIGKILL, it ends the descendants.
"""

import atexit
import itertools
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Set
from contextlib import contextmanager, suppress

if __name__ == "__main__":  # the guard, whose interpreter starts without a look for packages
    for number in (signal.SIGINT, signal.SIGTERM):  # a service manager sends it to all processes of a service
        signal.signal(number, signal.SIG_IGN)
    sys.path[:] = sys.argv[2:]

import psutil

VARIABLE = "DREAMFLEET_DESCENDS_FROM"  # marks, each followed by a space
GUARD_LIMIT = 2.0  # seconds in which the guard ends the descendants of a process that exits (docs/how-to/monitor.md)
ROUNDS = 20  # a process may fork while the others are looked for
_TOKEN = f"{os.getpid()}-{os.urandom(8).hex()}"
_numbers = itertools.count()
_lock = threading.Lock()
_sessions: set[int] = set()  # those that the guard knows
_guard: subprocess.Popen[bytes] | None = None


class Descendants:
    """The processes that descend from children which were started in `starting`."""

    def __init__(self) -> None:
        self._mark = f"{_TOKEN}-{next(_numbers)}"
        self._session: int | None = None

    @contextmanager
    def starting(self) -> Iterator[None]:
        """Start children inside; `OSError` if their guard cannot be started."""
        with _lock:
            _update_guard()
            before = os.environ.get(VARIABLE)
            os.environ[VARIABLE] = f"{before or ''}{_TOKEN} {self._mark} "
            try:
                yield
            finally:
                if before is None:
                    os.environ.pop(VARIABLE, None)  # what starts inside may have cleared the environment
                else:
                    os.environ[VARIABLE] = before

    def add_session(self, leader: int) -> None:
        """Count all processes of the session that the child `leader` begins as descendants too."""
        self._session = leader
        with _lock:
            _sessions.add(leader)
            with suppress(OSError):
                _update_guard(leader)

    def kill(self) -> None:
        """End them all with SIGKILL."""
        kill_descendants(self._mark, {self._session} if self._session else set())

    def forget(self) -> None:
        """Note that the session is over, so that its number may name another one."""
        with _lock:
            if self._session in _sessions:
                _sessions.remove(self._session)
                with suppress(OSError):
                    _update_guard(-self._session)
        self._session = None


def kill_descendants(mark: str, sessions: Set[int]) -> None:
    """End all processes with this mark or of these sessions with SIGKILL."""
    for group in sessions:
        with suppress(OSError):
            os.killpg(group, signal.SIGKILL)
    for _ in range(ROUNDS):
        if not (found := list(_find(mark, sessions))):
            return
        for process in found:
            with suppress(psutil.Error, OSError):
                process.kill()


def _find(mark: str, sessions: Set[int]) -> Iterator[psutil.Process]:
    """The running descendants."""
    pids: list[int] = []
    with suppress(psutil.Error, OSError):  # no `/proc`, or no descriptor left to read it
        pids = psutil.pids()
    for pid in pids:
        with suppress(psutil.Error, OSError):  # it has ended, or is another user's
            process = psutil.Process(pid)
            is_ours = os.getsid(pid) in sessions or mark in process.environ().get(VARIABLE, "").split()
            if is_ours and pid != os.getpid() and process.status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD):
                yield process


def _update_guard(*sessions: int) -> None:
    """Report begun sessions to the guard and, negative, ended ones; start it if there is none."""
    global _guard  # noqa: PLW0603 - one a process, as multiprocessing's resource tracker
    if _guard is None or _guard.poll() is not None:
        _guard = subprocess.Popen(  # noqa: S603 - this file in our own interpreter
            [sys.executable, "-I", "-S", __file__, _TOKEN, *map(str, sys.path)],
            stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True, bufsize=0, cwd="/",
        )  # fmt: skip
        atexit.unregister(_end_guard)
        atexit.register(_end_guard)
        sessions = (*_sessions, *sessions)
    assert _guard.stdin is not None
    _guard.stdin.write("".join(f"{each}\n" for each in sessions).encode())


def _end_guard() -> None:
    """Have the guard end all descendants now."""
    assert _guard is not None
    assert _guard.stdin is not None
    with suppress(OSError, subprocess.TimeoutExpired):
        _guard.stdin.close()
        _guard.wait(GUARD_LIMIT)


def main() -> None:
    """Be the guard: read sessions until the process that writes them ends, then end the descendants."""
    sessions: set[int] = set()
    for line in sys.stdin:
        session = int(line)
        if session > 0:
            sessions.add(session)
        else:
            sessions.discard(-session)
    kill_descendants(sys.argv[1], sessions)


if __name__ == "__main__":
    main()
