"""The standard streams of a verb: they may be closed, full, cut off, or of an encoding that lacks most characters."""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from io import BufferedWriter, FileIO, TextIOWrapper
from typing import Any

LAST_STREAM = 2  # file descriptor of stderr


def prepare_streams() -> None:
    """Open closed streams on nothing, write what an encoding lacks as escape sequences, and let stderr lose text."""
    _open_closed_streams()
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it greets on stdout, where a document may go
    if sys.stderr is sys.__stderr__ and isinstance(sys.stderr, TextIOWrapper):
        buffer = BufferedWriter(_LossyFile(LAST_STREAM, "w", closefd=False))
        sys.stderr = TextIOWrapper(buffer, sys.stderr.encoding, line_buffering=True, write_through=True)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a terminal may take ASCII, and a name be no UTF-8
            stream.reconfigure(errors="backslashreplace")


def discard_stdout() -> None:
    """Drop stdout's buffer, which cannot be written; else the interpreter would try again at exit."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _LossyFile(FileIO):
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
