"""Streams that never wait for whoever reads them: a full pipe must not freeze what is said along the way.

A terminal that is stopped, a pager, a log collector that hangs: once their pipe is full, a write to stderr waits
without end, and with it a loop, its signals and every thread that logs. Here a thread of its own writes. What it
cannot get rid of waits up to a bound; lines beyond it are dropped, and their number is said once the reader is back.
"""

from __future__ import annotations

import atexit
import io
import logging
import os
import queue
import sys
import threading
from typing import TextIO

MAX_WAITING_CHARS = 1 << 20  # characters: thousands of lines
EXIT_WAIT = 1.0  # seconds that a process which ends waits for its reader


class NonblockingStream(io.TextIOBase):
    """A text stream in the place of `stream`; whole lines reach its descriptor, in order, or are dropped and counted.

    The thread writes to the descriptor itself: the lock of Python's own stream, held by a thread that waits, would
    abort the interpreter at its end.
    """

    def __init__(self, stream: TextIO) -> None:
        stream.flush()
        self._stream = stream
        self._queue: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._lock = threading.RLock()
        self._partial_line = ""  # a line without its end
        self._waiting = 0
        self._dropped = 0
        self._written = threading.Event()
        self._written.set()
        threading.Thread(target=self._write_out, name="unblocked", daemon=True).start()

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """As the stream's."""
        return self._stream.encoding

    def fileno(self) -> int:
        """The descriptor, for child processes."""
        return self._stream.fileno()

    def isatty(self) -> bool:
        """Whether a person reads."""
        return self._stream.isatty()

    def writable(self) -> bool:
        """It is."""
        return True

    def write(self, text: str) -> int:
        """Take text; its whole lines are written soon."""
        with self._lock:
            whole, end, self._partial_line = (self._partial_line + text).rpartition("\n")
            if end:
                self._put(whole + end)
            if len(self._partial_line) > MAX_WAITING_CHARS:
                self.flush()
        return len(text)

    def flush(self) -> None:
        """Let what has no line's end be written too; waits for nothing."""
        with self._lock:
            begun, self._partial_line = self._partial_line, ""
            if begun:
                self._put(begun)

    def finish(self, limit: float = EXIT_WAIT) -> None:
        """Wait until everything is written, for `limit` seconds at most."""
        self.flush()
        self._written.wait(limit)

    def _put(self, text: str) -> None:
        if self._waiting + len(text) > MAX_WAITING_CHARS:
            self._dropped += text.count("\n") or 1
            return
        self._waiting += len(text)
        self._written.clear()
        self._queue.put(text)

    def _write_out(self) -> None:
        while True:
            text = self._queue.get()
            _write(self._stream.fileno(), text.encode(self.encoding, "backslashreplace"))
            with self._lock:
                self._waiting -= len(text)
                dropped = self._dropped if self._waiting == 0 else 0
                self._dropped -= dropped
                if dropped:
                    self._put(f"{dropped} lines were dropped here: nobody read them in time\n")
                elif self._waiting == 0:
                    self._written.set()


def make_stderr_nonblocking() -> None:
    """From now on nothing that this process says on stderr waits for a reader: logs, errors, tracebacks."""
    before = sys.stderr
    made = _make_nonblocking(before)
    if made is not None:
        sys.stderr = made
        for handler in logging.getLogger().handlers:
            if isinstance(handler, logging.StreamHandler) and handler.stream is before:
                handler.setStream(made)


def make_stdout_nonblocking() -> None:
    """The same for stdout: of a process whose prints are a task's chatter, not an answer."""
    sys.stdout = _make_nonblocking(sys.stdout) or sys.stdout


def _make_nonblocking(stream: TextIO | None) -> NonblockingStream | None:
    """The stream's replacement; `None` where there is nothing to replace: it is closed, or no thread can be had."""
    try:
        if stream is None or isinstance(stream, NonblockingStream):
            return None
        stream.fileno()
        made = NonblockingStream(stream)
    except (OSError, ValueError, RuntimeError):
        return None
    atexit.register(made.finish)
    return made


def _write(descriptor: int, data: bytes) -> None:
    """All of it, however long that takes; a reader that is gone has nothing to miss."""
    left = memoryview(data)
    try:
        while left:
            left = left[os.write(descriptor, left) :]
    except OSError:
        return
