"""What a verb reports to the program that started it: named values, each a line of JSON, beside what it logs."""

import json
import os
from contextlib import suppress
from typing import Any
from weakref import finalize

VARIABLE = "DREAMFLEET_REPORTS"  # where this process reports: a file's path, or the number of an inherited descriptor
FAILURE = "failure"  # why the verb fails
ADDRESS = "address"  # where a server that answers from now on is reached
WARNING = "warning"  # what the check of a run's task found
BEGUN = "begun"  # the verb's settings are right, and it begins its work
_targets: list[int] = []


def adopt_reports() -> None:
    """Report from now on to where the starting program says; what this process starts does not report there."""
    if not (place := os.environ.pop(VARIABLE, "")):
        return
    with suppress(OSError):
        if place.isdecimal():
            target = int(place)
            os.set_inheritable(target, False)
        else:
            target = os.open(place, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600)
        os.set_blocking(target, False)
        _targets.append(target)


def report(name: str, value: Any) -> None:
    """Report a value; it is dropped if nobody reads it."""
    for target in _targets:
        with suppress(OSError):
            os.write(target, json.dumps({name: value}).encode() + b"\n")


class ReportPipe:
    """The reports of one child process; `write` is the descriptor that it inherits."""

    def __init__(self) -> None:
        read, self.write = os.pipe()
        os.set_blocking(read, False)
        self._read, self._rest = read, b""
        self._found: dict[str, list[Any]] = {}
        finalize(self, os.close, read)

    def find(self, name: str) -> list[Any]:
        """All values of this name so far, the oldest first."""
        with suppress(BlockingIOError):
            while data := os.read(self._read, 1 << 16):
                self._rest += data
        *lines, self._rest = self._rest.split(b"\n")
        for line in lines:
            with suppress(ValueError, AttributeError):
                for each, value in json.loads(line).items():
                    self._found.setdefault(each, []).append(value)
        return self._found.get(name, [])
