"""The child process of a dry run, whose environment may do anything: each wait for it ends, and nothing outlives it."""

import os
import selectors
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from time import monotonic

from dreamfleet.common.host.child import CommandChild
from dreamfleet.common.host.parent_death import parent_death_command
from dreamfleet.common.printable import one_line

LOOK_INTERVAL = 0.1  # seconds between two looks whether the child runs: a process that it left may hold its pipes
EXIT_GRACE = 10.0  # seconds that the child may take to exit after it closed its pipe
KILL_GRACE = 2.0  # seconds to wait for the end of a killed child: its host may block it
CHUNK = 65_536  # bytes
MAX_BYTES = 16 * 2**20  # that a dry run may print, and that it may answer
KEPT_BYTES = 65_536  # of what it printed last
MAX_FAULT_CHARS = 300  # of what a crashed child printed last


class DryRunError(Exception):
    """The dry run was ended; the text says what its environment did."""


class DryRunProcess(CommandChild):
    """A module that reads its request from stdin, writes lines to stdout, and prints to stderr. Use it in a `with`.

    Its argument is a file descriptor, which is closed by `begin`: until then it only loads what it needs. This class
    reads both pipes itself, because here no wait may be without end, and no output without limit.
    """

    def __init__(self, module: str, request: str, hash_seed: int) -> None:
        """`hash_seed` is Python's own, by which texts are hashed: the order of a set depends on it."""
        waits, self._go = os.pipe()
        self._lines: list[bytes] = []  # unread, the next one last
        self._begun = bytearray()  # a line without its end
        self._printed = bytearray()
        self._sizes = [0, 0]  # bytes that it answered and printed
        python = sys.executable, "-P", "-m", module
        with tempfile.TemporaryFile() as stdin:
            stdin.write(request.encode())
            stdin.seek(0)
            super().__init__(
                ["/usr/bin/env", f"PYTHONHASHSEED={hash_seed}", *parent_death_command(), *python, str(waits)],
                stdin=stdin, stdout=subprocess.PIPE, stderr=subprocess.PIPE, bufsize=0, pass_fds=(waits,),
            )  # fmt: skip
        os.close(waits)
        self._selector = selectors.DefaultSelector()
        self._pipes = [each for each in (self.popen.stdout, self.popen.stderr) if each is not None]
        for number, pipe in enumerate(self._pipes):
            os.set_blocking(pipe.fileno(), False)
            self._selector.register(pipe, selectors.EVENT_READ, number)

    def end(self, timeout: float = 0, limit: float = KILL_GRACE) -> bool:
        """Kill it, and close its pipes."""
        has_ended = super().end(timeout, limit)
        self.begin()
        self._selector.close()
        for pipe in self._pipes:
            pipe.close()
        return has_ended

    def begin(self, word: bytes = b"") -> None:
        """Let it begin its dry run; it reads the `word` of one byte, if there is one, from the descriptor."""
        if self._go >= 0:
            with suppress(OSError):  # it may have ended
                os.write(self._go, word)
            os.close(self._go)
            self._go = -1

    def read_line(self, seconds: float) -> bytes | None:
        """The next line of stdout, or `None` if the child ended; `DryRunError` after `seconds` or too much output."""
        until, late = monotonic() + seconds, f"took longer than {seconds:.4g} s"
        is_closed = False
        while not self._lines:
            has_ended = self.exit_code is not None
            if has_ended:
                self.kill()  # then its pipes hold only what was written before
            ready = self._selector.select(0 if has_ended else LOOK_INTERVAL)
            for key, _ in ready:
                self._read(key)
            if has_ended and not ready:
                return None
            if not is_closed and self._answers_ended():
                is_closed, limit = True, monotonic() + EXIT_GRACE
                if limit < until:
                    until, late = limit, "closed the pipe of this check"
            if monotonic() > until:
                raise DryRunError(late)
        return self._lines.pop()

    def describe_failure(self) -> str:
        """How the ended child ended before it was through, and what it printed last."""
        code = self.popen.returncode
        how = f"crashed ({_signal_name(-code)})" if code < 0 else f"ended the process (exit code {code})"
        lines = self._printed.decode(errors="replace").splitlines()
        words = [text for line in lines if (text := one_line(line))]
        return f"{how}: {words[-1][:MAX_FAULT_CHARS]}" if words else how

    def _answers_ended(self) -> bool:
        return all(key.data != 0 for key in self._selector.get_map().values())

    def _read(self, key: selectors.SelectorKey) -> None:
        chunk = os.read(key.fd, CHUNK)
        self._sizes[key.data] += len(chunk)
        if self._sizes[key.data] > MAX_BYTES:
            deed = "printed" if key.data else "wrote to the pipe of this check"
            raise DryRunError(f"{deed} more than {MAX_BYTES >> 20} MiB")
        if not chunk:
            self._selector.unregister(key.fileobj)
        elif key.data:
            self._printed += chunk
            del self._printed[:-KEPT_BYTES]
        else:
            self._begun += chunk
            if b"\n" in chunk:
                *lines, self._begun = self._begun.split(b"\n")
                self._lines[:0] = [bytes(line) for line in reversed(lines)]


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # a real-time signal
        return f"signal {number}"
