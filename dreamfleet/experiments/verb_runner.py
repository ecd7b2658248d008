"""Run verbs from other verbs, each in a process of its own."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from itertools import takewhile
from pathlib import Path
from typing import Any

from dreamfleet.common.cli.command_line import GROUP, Verb, load_verb
from dreamfleet.common.errors import DreamfleetError, StoppedError, UsageError
from dreamfleet.common.host.processes import VerbProcess
from dreamfleet.common.host.stop_signals import Stop

POLL_INTERVAL = 0.2  # seconds between checks whether to stop
STOP_TIMEOUT = 15.0  # seconds that a verb has to end once asked: a training finishes its update first


def find_verb(words: Sequence[str]) -> tuple[str, Verb, Sequence[str]]:
    """The verb that a command line begins with, by its entry point: its name, the verb, and the words behind it."""
    for length in (2, 1):
        name = ".".join(words[:length])
        if points := entry_points(group=GROUP, name=name):
            return name, load_verb(next(iter(points))), words[length:]
    raise DreamfleetError(f"no verb {' '.join(words[:1])!r} is installed")


class ProcessRunner:
    """Runs each verb in a child process, which ends with this one; `stop` ends the verb early."""

    def __init__(self, stop: Stop) -> None:
        self._stop = stop

    def run_for_json(self, words: Sequence[str], log: Path, on_line: Callable[[str], None] = lambda _line: None) -> Any:
        """Run a verb as `run` does, and return its JSON answer."""
        return json.loads(self.run(words, log, on_line).splitlines()[-1])

    def run(self, words: Sequence[str], log: Path, on_line: Callable[[str], None] = lambda _line: None) -> str:
        """Run a verb to its end and return its stdout; each line of its stderr goes to `log` and to `on_line`.

        A wrong command is a `UsageError`, a stop a `StoppedError`, any other failure a `DreamfleetError`.
        """
        name = " ".join(takewhile(lambda word: not word.startswith("-"), map(str, words[:2])))
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("w", encoding="utf-8", errors="backslashreplace") as kept:

            def forward_lines() -> None:
                for line in child.new_lines():
                    kept.write(line)
                    kept.flush()
                    on_line(line.strip())

            child = VerbProcess(*words, ends_with_parent=True)
            try:
                wait_for_end(child, self._stop, forward_lines)
                code, out = child.finish()
            finally:
                child.end(STOP_TIMEOUT)
                forward_lines()
        if code == 0:
            return out
        if code == StoppedError.exit_code:
            raise StoppedError(f"{name} was stopped")
        if code == UsageError.exit_code:
            raise UsageError(child.last_line())
        raise DreamfleetError(f"{child.last_line()} ({name} exited with {code}; its log is {log})")


def wait_for_end(
    child: VerbProcess, stop: Stop, on_poll: Callable[[], None] = lambda: None, interval: float = POLL_INTERVAL
) -> None:
    """Wait until a verb has ended, calling `on_poll` meanwhile; `StoppedError` as soon as `stop` is true."""
    while not child.wait(0):
        if stop():
            raise StoppedError("stopped")
        on_poll()
        child.wait(interval)
