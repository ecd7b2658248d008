"""Our own verbs as processes: started, listened to, ended. The demonstration, the benchmarks and the tests use it."""

from __future__ import annotations

import json
import os
import queue
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, Any

from dreamfleet.common.errors import DreamfleetError

KEPT_LINES = 10_000  # of each stream that are kept at least
PATIENCE = 3.0  # seconds after each request to leave


def command(*words: object) -> list[str]:
    """The command line of a verb in this interpreter. `-P`: a module in the current folder is never taken for ours."""
    return [sys.executable, "-P", "-m", "dreamfleet", *map(str, words)]


def shell_command(*words: object) -> str:
    """The same verb as a person writes it into this shell, the way that this program was started."""
    started = Path(sys.argv[0])
    known = shutil.which("dreamfleet")
    if started.name == "__main__.py":
        program = [sys.executable, "-m", "dreamfleet"]
    elif known and started.exists() and started.samefile(known):
        program = ["dreamfleet"]
    else:
        program = [str(started)]
    return shlex.join([*program, *map(str, words)])


def parent_death_command() -> tuple[str, ...]:
    """What a command runs `inside` so that it ends with this process, however this one ends; of Linux."""
    return (sys.executable, "-P", "-m", "dreamfleet.common.host.parent_death", str(os.getpid()))


def run_verb_to_end(*words: object) -> None:
    """Run a verb to its end in this terminal; `DreamfleetError` if it fails."""
    if subprocess.run(command(*words), check=False).returncode != 0:  # noqa: S603 - our own interpreter and verb
        raise DreamfleetError(f"dreamfleet {words[0]} failed")


def run_verb_for_json(*words: object) -> Any:
    """Run a verb to its end, its progress in this terminal, and read the JSON that it prints."""
    done = subprocess.run(command(*words), check=False, stdout=subprocess.PIPE)  # noqa: S603 - our own interpreter
    if done.returncode != 0:
        raise DreamfleetError(f"dreamfleet {words[0]} failed")
    return json.loads(done.stdout)


class VerbProcess:
    """A verb that runs. What it says is read at once, or goes to `log`: it never waits for a reader.

    Use it in a `with`, or call `end`. It leads a session of its own, so that Ctrl-C reaches the parent alone.
    """

    def __init__(
        self,
        *words: object,
        log: Path | None = None,
        environment: Mapping[str, str] | None = None,
        inside: Sequence[str] = (),
        read: Callable[[IO[bytes]], None] | None = None,
    ) -> None:
        """`read` takes its stdout, in a thread of its own, where that is no text; it ends with the stream."""
        self.lines: list[str] = []  # of stderr, the last of them
        self._log = log
        self._out: deque[str] = deque(maxlen=KEPT_LINES)
        self._new_lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        with ExitStack() as stack:
            if log is not None:
                log.parent.mkdir(parents=True, exist_ok=True)
            target = subprocess.PIPE if log is None else stack.enter_context(log.open("wb"))
            self.popen = subprocess.Popen(  # noqa: S603 - our own interpreter and verb
                [*inside, *command(*words)], stdout=target, stderr=target, env=environment, start_new_session=True
            )
        streams = (
            (self.popen.stdout, read or (lambda stream: _drain(stream, self._out.append, None))),
            (self.popen.stderr, lambda stream: _drain(stream, self._add_line, self._new_lines)),
        )
        self._readers = [
            threading.Thread(target=take, args=(stream,), daemon=True) for stream, take in streams if stream is not None
        ]
        for reader in self._readers:
            reader.start()

    def __enter__(self) -> VerbProcess:
        return self

    def __exit__(self, *_error: object) -> None:
        self.end()

    def wait_for(self, text: str, times: int = 1, timeout: float = 60.0) -> str:
        """Block until `text` was said on stderr so many times since the last wait; the line that said it."""
        deadline, line = time.monotonic() + timeout, None
        while times:
            try:
                line = self._new_lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise DreamfleetError(f"{text!r} was not said within {timeout:g} s; {self.last_line()}") from None
            if line is None:
                raise DreamfleetError(f"ended before saying {text!r}:\n{''.join(self.lines)}")
            times -= text in line
        return line or ""

    def new_lines(self) -> list[str]:
        """Lines that were said on stderr and that nobody has waited for or taken yet."""
        lines: list[str] = []
        with suppress(queue.Empty):
            while (line := self._new_lines.get_nowait()) is not None:
                lines.append(line)
        return lines

    def finish(self, timeout: float | None = None) -> tuple[int, str]:
        """Wait for the end: exit code and stdout."""
        code = self.popen.wait(timeout)
        self._join()
        return code, "".join(self._out)

    def last_line(self) -> str:
        """The last line of its log, or of stderr."""
        lines: Iterable[str] = self.lines if self._log is None else self._log.read_text(errors="replace").splitlines()
        said = [line.strip() for line in lines if line.strip()]
        return said[-1].removeprefix("dreamfleet: ") if said else "it ended without a word"

    def end(self, patience: float = PATIENCE) -> None:
        """Ask it to leave, and again; then end it and all that it started."""
        for _ in range(2 if patience else 0):
            if self.popen.poll() is None:
                self.popen.send_signal(signal.SIGTERM)
                _wait(self.popen, patience)
        if self.popen.poll() is None:
            os.killpg(self.popen.pid, signal.SIGKILL)
        self.popen.wait()
        self._join()

    def _add_line(self, line: str) -> None:
        self.lines.append(line)
        if len(self.lines) > 2 * KEPT_LINES:
            del self.lines[:KEPT_LINES]
        self._new_lines.put(line)

    def _join(self) -> None:
        for reader in self._readers:
            reader.join(PATIENCE)  # a grandchild may hold the pipe


def _drain(stream: IO[bytes], take: Callable[[str], None], end: queue.SimpleQueue[str | None] | None) -> None:
    with stream:
        for line in stream:
            take(line.decode(errors="replace"))
    if end is not None:
        end.put(None)


def _wait(popen: subprocess.Popen[bytes], seconds: float) -> None:
    with suppress(subprocess.TimeoutExpired):
        popen.wait(seconds)
