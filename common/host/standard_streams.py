"""The standard streams of a verb: they may be closed, full, cut off, or of an encoding that lacks most characters.

Those of a long-lived process never block on a slow reader either. When a stopped terminal, a pager or a hanging log
collector leaves its pipe full, a write to stderr blocks, and with it a loop, its signal handlers and every thread that
logs. So a background thread writes. Its queue is bounded; further lines are dropped, and their number is written once
the reader is back. Pages: monitor.md.
"""

import atexit
import io
import logging
import os
import queue
import sys
import threading
from contextlib import suppress
from typing import Any, TextIO

LAST_STREAM = 2  # file descriptor of stderr
MAX_WAITING_CHARS = 1 << 20  # thousands of lines
EXIT_WAIT = 1.0  # seconds that an ending process waits for its reader


def prepare_streams() -> None:
    """Open closed streams on nothing, write what an encoding lacks as escape sequences, and let stderr lose text."""
    _open_closed_streams()
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it greets on stdout, where a document may go
    if sys.stderr is sys.__stderr__ and isinstance(sys.stderr, io.TextIOWrapper):
        buffer = io.BufferedWriter(_LossyFile(LAST_STREAM, "w", closefd=False))
        sys.stderr = io.TextIOWrapper(buffer, sys.stderr.encoding, line_buffering=True, write_through=True)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal may take ASCII, and a name be no UTF-8
            stream.reconfigure(errors="backslashreplace")


def discard_stdout() -> None:
    """Drop stdout's buffer, which cannot be written; else the interpreter would try again at exit."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _LossyFile(io.FileIO):
    """Drops what cannot be written: a full disk under a log, a pipe without a reader, a closed terminal end no run."""

    def write(self, data: Any) -> int:
        """Write, or drop all."""
        try:
            return super().write(data)
        except BlockingIOError:
            raise
        except OSError:
            return len(data)


def _open_closed_streams() -> None:
    """Open closed standard streams (`>&-`) on /dev/null; else the next opened file, such as a journal, gets output."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= LAST_STREAM:
        os.set_inheritable(number, True)
    os.close(number)
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115 - never closed


class NonblockingStream(io.TextIOBase):
    """A replacement for `stream`: writes whole lines to its descriptor, in order, or drops and counts them.

    The thread writes to the descriptor, not to the stream: a blocked thread that holds a stream's lock aborts the
    interpreter at exit.
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
        """The original stream's encoding."""
        return self._stream.encoding

    def fileno(self) -> int:
        """The descriptor, for child processes."""
        return self._stream.fileno()

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return self._stream.isatty()

    def writable(self) -> bool:
        """Always True."""
        return True

    def write(self, text: str) -> int:
        """Queue text; its whole lines are written soon."""
        with self._lock:
            whole, end, self._partial_line = (self._partial_line + text).rpartition("\n")
            if end:
                self._put(whole + end)
            if len(self._partial_line) > MAX_WAITING_CHARS:
                self.flush()
        return len(text)

    def flush(self) -> None:
        """Queue an unfinished line too; does not block."""
        with self._lock:
            partial_line, self._partial_line = self._partial_line, ""
            if partial_line:
                self._put(partial_line)

    def finish(self, limit: float = EXIT_WAIT) -> None:
        """Wait until everything is written, at most `limit` seconds."""
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
                    self._put(f"{dropped} lines were dropped here: they were not read in time\n")
                elif self._waiting == 0:
                    self._written.set()


def make_stderr_nonblocking() -> None:
    """Replace stderr, also in log handlers, by a stream that never blocks."""
    before = sys.stderr
    replacement = _make_nonblocking(before)
    if replacement is not None:
        sys.stderr = replacement
        for handler in logging.getLogger().handlers:
            if isinstance(handler, logging.StreamHandler) and handler.stream is before:
                handler.setStream(replacement)


def make_stdout_nonblocking() -> None:
    """Replace stdout by a stream that never blocks, in a process whose prints are not a verb's output."""
    sys.stdout = _make_nonblocking(sys.stdout) or sys.stdout


def _make_nonblocking(stream: TextIO | None) -> NonblockingStream | None:
    """The stream's replacement; `None` if it is closed or replaced already, or no thread can start."""
    try:
        if stream is None or isinstance(stream, NonblockingStream):
            return None
        stream.fileno()
        replacement = NonblockingStream(stream)
    except (OSError, ValueError, RuntimeError):
        return None
    atexit.register(replacement.finish)
    return replacement


def _write(descriptor: int, data: bytes) -> None:
    """Write all data, however long that blocks; returns early if the reader is gone."""
    left = memoryview(data)
    try:
        while left:
            left = left[os.write(descriptor, left) :]
    except OSError:
        return
