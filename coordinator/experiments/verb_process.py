"""A verb of a phase, run to its end: heard as JSON, logged, and ended with us."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from dreamfleet.common.errors import DreamfleetError, StoppedError, UsageError
from dreamfleet.common.host.processes import VerbProcess, parent_death_command
from dreamfleet.common.host.stop_signals import Stop

POLL_INTERVAL = 0.2  # seconds between looks at whether to stop
STOP_TIMEOUT = 15.0  # seconds that a verb has to leave when asked: an update of a training may take some


def wait(child: VerbProcess, stop: Stop, on_poll: Callable[[], None] = lambda: None) -> None:
    """Wait until it has ended; `StoppedError` as soon as `stop` is true, and whatever `on_poll` raises meanwhile."""
    while child.popen.poll() is None:
        if stop():
            raise StoppedError("stopped")
        on_poll()
        try:
            child.popen.wait(POLL_INTERVAL)
        except subprocess.TimeoutExpired:
            continue


def run_for_json(
    words: Sequence[str], log: Path, stop: Stop, on_line: Callable[[str], None] = lambda _line: None
) -> Any:
    """What a verb answers as JSON; otherwise as `run_verb`."""
    return json.loads(run_verb(words, log, stop, on_line).splitlines()[-1])


def run_verb(words: Sequence[str], log: Path, stop: Stop, on_line: Callable[[str], None] = lambda _line: None) -> str:
    """What a verb answers; its progress lines go to `log` and to `on_line` as they come.

    A wrong command is a `UsageError`, any other failure a `DreamfleetError`, with its last words.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as kept:

        def listen() -> None:
            for line in child.new_lines():
                kept.write(line)
                kept.flush()
                on_line(line.strip())

        child = VerbProcess(*words, inside=parent_death_command())
        try:
            wait(child, stop, listen)
            code, out = child.finish()
        finally:
            child.end(STOP_TIMEOUT)
            listen()
    if code == 0:
        return out
    if code == StoppedError.exit_code:
        raise StoppedError(f"{words[0]} was told to stop")
    if code == UsageError.exit_code:
        raise UsageError(child.last_line())
    raise DreamfleetError(f"{child.last_line()} ({words[0]} left with {code}; its words are in {log})")
