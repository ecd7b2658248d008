"""Dreamfleet's verbs as child processes, for the demonstration, the benchmarks, experiments and tests."""

import os
import shlex
import shutil
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.host.child import END_TIMEOUT, KILL_LIMIT, CommandChild
from dreamfleet.common.host.parent_death import parent_death_command
from dreamfleet.common.host.reports import FAILURE, VARIABLE, ReportPipe

KEPT_LINES = 10_000  # the last lines of each stream that are kept, at least
POLL_INTERVAL = 0.02  # seconds between two looks at what a verb reported


def command(*words: object) -> list[str]:
    """The command line of a verb in this interpreter. `-P`: never import modules from the current folder."""
    return [sys.executable, "-P", "-m", "dreamfleet", *map(str, words)]


def shell_command(*words: object) -> str:
    """A verb's command line for display and copying, with this program's name as it was started."""
    started = Path(sys.argv[0])
    known = shutil.which("dreamfleet")
    if started.name == "__main__.py":
        program = [sys.executable, "-m", "dreamfleet"]
    elif known and started.exists() and started.samefile(known):
        program = ["dreamfleet"]
    else:  # else a program or notebook of the user, which is not ours to repeat
        program = [str(started) if started.name == "dreamfleet" else "dreamfleet"]
    return shlex.join([*program, *map(str, words)])


class VerbProcess(CommandChild):
    """A running verb. Threads read its output, or it goes to the file `log`, so that it never blocks on a reader.

    One that `ends_with_parent` ends with the thread that starts it.
    """

    def __init__(
        self, *words: object, log: Path | None = None, environment: Mapping[str, str] | None = None,
        inside: Sequence[str] = (), read: Callable[[IO[bytes]], None] | None = None, ends_with_parent: bool = False,
    ) -> None:  # fmt: skip
        """`inside` is a prefix of the command; `read` consumes a binary stdout in a thread, until its end."""
        self.lines: list[str] = []  # the last lines of stderr
        self._log = log
        self._out: deque[str] = deque(maxlen=KEPT_LINES)
        self._reports = ReportPipe()
        inherited = {**(os.environ if environment is None else environment), VARIABLE: str(self._reports.write)}
        within = (*inside, *(parent_death_command() if ends_with_parent else ()))
        with ExitStack() as stack:
            stack.callback(os.close, self._reports.write)
            if log is not None:
                log.parent.mkdir(parents=True, exist_ok=True)
            target = subprocess.PIPE if log is None else stack.enter_context(log.open("wb"))
            super().__init__(
                [*within, *command(*words)], is_own=True,
                stdout=target, stderr=target, env=inherited, pass_fds=(self._reports.write,),
            )  # fmt: skip
        streams = (
            (self.popen.stdout, read or (lambda stream: _drain(stream, self._out.append))),
            (self.popen.stderr, lambda stream: _drain(stream, self._add_line)),
        )
        self._readers = [
            threading.Thread(target=take, args=(stream,), daemon=True) for stream, take in streams if stream is not None
        ]
        for reader in self._readers:
            reader.start()

    def reports(self, name: str) -> list[Any]:
        """What it reported under this name so far, the oldest first."""
        return self._reports.find(name)

    def wait_for_report(self, name: str, timeout: float = 60.0) -> Any:
        """Block until it reports a value of this name; `DreamfleetError` if it ends before, or does not in time."""
        deadline = time.monotonic() + timeout
        while True:
            has_ended = self.exit_code is not None
            if found := self.reports(name):
                return found[0]
            if has_ended or time.monotonic() > deadline:
                raise DreamfleetError(f"it reported no {name} within {timeout:g} s; {self.last_line()}")
            time.sleep(POLL_INTERVAL)

    def finish(self, timeout: float | None = None) -> tuple[int, str]:
        """Wait for the end; returns the exit code and stdout."""
        code = self.popen.wait(timeout)
        self._join()
        return code, "".join(self._out)

    def last_line(self) -> str:
        """Why it failed, as it reported; else the last line of its log, or of stderr, and which signal killed it."""
        if reported := self.reports(FAILURE):
            return str(reported[-1])
        lines: Iterable[str] = self.lines if self._log is None else self._log.read_text(errors="replace").splitlines()
        printed = [line.strip() for line in lines if line.strip()]
        said = printed[-1] if printed else "it printed nothing"
        code = self.exit_code
        return said if code is None or code >= 0 else f"killed by signal {-code}; its last line: {said}"

    def end(self, timeout: float = END_TIMEOUT, limit: float = KILL_LIMIT) -> bool:
        """As `Child.end`, and wait for the last lines."""
        has_ended = super().end(timeout, limit)
        self._join()
        return has_ended

    def _add_line(self, line: str) -> None:
        self.lines.append(line)
        if len(self.lines) > 2 * KEPT_LINES:
            del self.lines[:KEPT_LINES]

    def _join(self) -> None:
        for reader in self._readers:
            reader.join(END_TIMEOUT)  # a grandchild may hold the pipe


def _drain(stream: IO[bytes], take: Callable[[str], None]) -> None:
    with stream:
        for line in stream:
            take(line.decode(errors="replace"))
