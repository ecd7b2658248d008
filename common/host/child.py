"""One child process of this one: it ends with its parent, leaves Ctrl-C to it, and takes along what it started."""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import threading
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from time import monotonic, sleep
from typing import Any, Self

import psutil

from dreamfleet.common.host.descendants import Descendants
from dreamfleet.common.host.parent_death import exit_with_parent, signals_blocked
from dreamfleet.common.host.stop_signals import outlive_stop_signals

END_TIMEOUT = 3.0  # seconds to wait after each SIGTERM
KILL_LIMIT = 30.0  # seconds to wait after SIGKILL: a process in a system call that does not return does not end
FIRST_POLL, LAST_POLL = 0.001, 0.02  # seconds between two looks whether it has ended: few at first, then more


class Child:
    """A running child in a session of its own. Use it in a `with`, or call `end`.

    Where it runs code of others, `kill` also finds what left its session and parent (`Descendants`), and a guard does
    that if this process is killed. Our own verbs do so themselves: of one that `is_own`, `kill` ends the process group.
    """

    def __init__(self, begin: Callable[[], subprocess.Popen[bytes] | BaseProcess], *, is_own: bool = False) -> None:
        """`begin` starts it; `OSError` if it, or its guard, cannot be started."""
        self._descendants = None if is_own else Descendants()
        with self._descendants.starting() if self._descendants else nullcontext():
            self._process = begin()
        if self._descendants:
            self._descendants.add_session(self.pid)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.end()

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid or 0

    @property
    def exit_code(self) -> int | None:
        """Its exit code, or the negative number of the signal that ended it; `None` while it runs."""
        return self._process.poll() if isinstance(self._process, subprocess.Popen) else self._process.exitcode

    @property
    def memory(self) -> int:
        """Resident bytes; 0 if unknown."""
        try:
            return int(psutil.Process(self.pid).memory_info().rss)
        except (psutil.Error, OSError):
            return 0

    def wait(self, seconds: float) -> bool:
        """Wait up to `seconds` for its end; return whether it has ended."""
        until, pause = monotonic() + seconds, FIRST_POLL
        while self.exit_code is None:  # a timed `join` can block on a silent child
            if (left := until - monotonic()) <= 0:
                return False
            sleep(min(pause, left))
            pause = min(2 * pause, LAST_POLL)
        return True

    def ask_to_end(self) -> None:
        """Send it SIGTERM."""
        if self.exit_code is None:
            with suppress(OSError):
                os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        """End it and what it started with SIGKILL."""
        if self.exit_code is None:  # else its number may name another process
            for send in (os.killpg, os.kill):  # it may not lead its group yet
                with suppress(OSError):
                    send(self.pid, signal.SIGKILL)
        if self._descendants:
            self._descendants.kill()

    def end(self, timeout: float = END_TIMEOUT, limit: float = KILL_LIMIT) -> bool:
        """Send SIGTERM, twice if needed, each with so much `timeout`; then kill it. Return whether it has ended."""
        for _ in range(2 if timeout else 0):
            self.ask_to_end()
            self.wait(timeout)
        self.kill()
        has_ended = self.wait(limit)  # else it is left behind: docs/how-to/monitor.md
        if self._descendants:
            self._descendants.forget()
        return has_ended


class CommandChild(Child):
    """A child that runs a command."""

    def __init__(self, words: Sequence[str], *, is_own: bool = False, **options: Any) -> None:
        """`options` are those of `Popen`; an `env` is for one that `is_own`. `OSError` if it cannot be started."""
        begin = lambda: subprocess.Popen(words, start_new_session=True, **options)  # noqa: E731, S603 - the caller's
        super().__init__(begin, is_own=is_own)

    @property
    def popen(self) -> subprocess.Popen[bytes]:
        """The process, with its pipes."""
        assert isinstance(self._process, subprocess.Popen)
        return self._process


class FunctionChild(Child):
    """A child that calls `function(pipe, *arguments)`; it is spawned, because a forked Zenoh session hangs.

    A thread calls `on_message` with each of its messages, and with `None` at the end: the pipe was closed, or rubbish
    written into it, or `on_message` raised an error.
    """

    def __init__(
        self, function: Callable[..., object], *arguments: Any, on_message: Callable[[Any], None],
        is_own: bool = False, ends_with_parent: bool = True, send_limit: int = 0,
    ) -> None:  # fmt: skip
        """`send_limit`: seconds that it may leave its full pipe unread; 0: no limit.

        One that does not end with its parent hears that its pipe is closed.
        """
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        with socket.socket(fileno=os.dup(self._pipe.fileno())) as ours:
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", send_limit, 0))
        parent = os.getpid() if ends_with_parent else 0
        process = context.Process(
            target=_call_in_child,
            args=(parent, function, theirs, arguments),
            daemon=is_own,  # a simulator may start processes with `multiprocessing`, which daemons may not
        )

        def begin() -> BaseProcess:
            process.start()
            return process

        with signals_blocked():  # outside of what a mark is for: it may start multiprocessing's own helper
            super().__init__(begin, is_own=is_own)
        theirs.close()
        self._reader = threading.Thread(target=self._read, args=(on_message,), daemon=True)
        try:
            self._reader.start()
        except RuntimeError:  # the thread cannot start, so nothing would read the child's messages
            super().end(0)
            raise

    @property
    def is_heard(self) -> bool:
        """Whether its messages are read: its pipe is open."""
        return self._reader.is_alive()

    def send(self, message: Any) -> bool:
        """Send it a message; return whether it reads: it may be suspended. If it is gone, the reader notices."""
        try:
            self._pipe.send(message)
        except BlockingIOError:
            return False
        except OSError:
            pass
        return True

    def end(self, timeout: float = 0, limit: float = KILL_LIMIT) -> bool:
        """As `Child.end`, and close the pipe, unless something still holds its other side after `limit` seconds."""
        has_ended = super().end(timeout, limit)
        self._reader.join(limit)
        if not self._reader.is_alive():  # else another pipe may get its descriptor while it still reads
            self._pipe.close()
        return has_ended

    def _read(self, on_message: Callable[[Any], None]) -> None:
        with suppress(Exception):
            while True:
                on_message(self._pipe.recv())
        on_message(None)


def _call_in_child(
    parent: int, function: Callable[..., object], pipe: Connection[Any, Any], arguments: Sequence[Any]
) -> None:
    """Be the child of the process `parent`; 0: do not end with it."""
    if parent:
        exit_with_parent(parent)
    os.setsid()
    outlive_stop_signals()
    os.register_at_fork(after_in_child=pipe.close)  # a copy would hide this process's end from the parent
    function(pipe, *arguments)
