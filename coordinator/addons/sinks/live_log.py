"""Processes beside the coordinator that write a run's curves to other programs while the run goes on.

Each reads the journal, as any reader does, and writes what its record lacks. So it can stall nothing and misses
nothing: a slow or absent server, or a kill, only delays steps. Pages: decisions.md.
"""

import logging
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic
from typing import Any

from dreamfleet.common.files.locks import open_lock, wait_for_lock
from dreamfleet.common.host.child import FunctionChild
from dreamfleet.common.host.stop_signals import end_within
from dreamfleet.common.printable import one_line, truncate
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.addons.runs.export import scalars_of
from dreamfleet.coordinator.addons.sinks.sinks import Sink, open_sink
from dreamfleet.coordinator.settings.live_log import SinkName, parse_sink

log = logging.getLogger(__name__)
INTERVAL = 1.0  # seconds between two looks at the journal
RETRY = 30.0  # seconds after an error until a record is tried again
GRACE = 60.0  # seconds that the end of a run waits for its records: the import of a library alone may take ten
LONGEST = 300  # characters of an error
OURS = ("fitness__", "search__", "effort__", "score__")  # groups of curves, as `scalars_of` names them
Report = Callable[[str], None]


@contextmanager
def live_log(run: Path, log_to: Sequence[str]) -> Iterator[None]:
    """Write the curves of the run in this folder to the records that `log_to` names, each by a process of its own.

    The end waits `GRACE` seconds at most for what is not written yet.
    """
    running = [_Follower(run, each) for each in log_to]
    try:
        yield
    finally:
        until = monotonic() + GRACE
        for follower in running:
            follower.ask_to_end()
        for follower in running:
            follower.end(until)


class _Follower:
    """A process that follows a run for one record; it hands over the last steps of a killed coordinator, too."""

    def __init__(self, run: Path, text: str) -> None:
        self._kind = parse_sink(text).kind  # what follows it may hold a password
        self._is_over = False
        arguments = run.absolute(), parse_sink(text)
        self._child = FunctionChild(
            _follow_in_child, *arguments, on_message=self._relay, is_own=True, ends_with_parent=False
        )

    def ask_to_end(self) -> None:
        """Let it write the last steps and end."""
        self._is_over = True
        self._child.send(None)

    def end(self, until: float) -> None:
        """Wait for its end, which was asked for, until this time."""
        if not self._child.wait(until - monotonic()):
            log.warning("%s had not taken everything %g s after the run's end: the last steps may be missing there",
                        self._kind, GRACE)  # fmt: skip
        self._child.end()

    def _relay(self, text: str | None) -> None:
        if text is not None:
            log.warning("%s", text)
        elif not self._is_over:
            log.warning("the process that writes the curves to %s has ended: the run goes on, and a resumed run writes "
                        "what is missing there", self._kind, extra={"facts": {"event": "curves ended"}})  # fmt: skip


def _follow_in_child(pipe: Any, run: Path, name: SinkName) -> None:
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in (1, 2):  # libraries print there
        os.dup2(silent, stream)

    def is_over() -> bool:
        """Whether the coordinator ends, or was killed: then this process ends soon, whatever it waits for."""
        if not pipe.poll(INTERVAL):
            return False
        try:
            pipe.recv()
        except (EOFError, OSError):
            end_within(GRACE, 1)
        return True

    def report(text: str) -> None:
        with suppress(OSError):  # the parent is gone
            pipe.send(text)

    with open_lock(run / f"log-to-{name.kind}.lock") as lock:
        wait_for_lock(lock)  # the process of a killed coordinator may still hand its last steps over
        follow(run, name, is_over, report)


def follow(run: Path, name: SinkName, is_over: Callable[[], bool], report: Report) -> None:
    """Write what the record lacks, again and again, and a last time once `is_over()`; then close it."""
    mirror, ending = _Mirror(name, report), False
    while not ending:
        ending = is_over()  # before the look: what was journaled until now is then written
        mirror.update(run, monotonic(), at_once=ending)
    mirror.close()


class _Mirror:
    """One record, which is kept equal to the journal, and opened again some time after an error."""

    def __init__(self, name: SinkName, report: Report) -> None:
        self._name, self._report = name, report
        self._sink: Sink | None = None
        self._since = 0  # the generations before it are in the record
        self._retry_at = -math.inf
        self._has_failed = False

    def update(self, run: Path, now: float, *, at_once: bool) -> None:
        """Write what the record lacks."""
        if now < self._retry_at and not at_once:
            return
        try:
            with RunFolder(run) as folder:
                if self._sink is None:
                    self._sink, self._since = open_sink(self._name, folder), 0
                self._write(self._sink, folder)
            if self._has_failed:
                self._report(f"the curves go to {self._name.kind} again, and nothing is missing there")
            self._has_failed = False
        except BaseException as error:  # a library may raise anything
            self._retry_at = now + RETRY
            if not self._has_failed:
                what = truncate(one_line(f"{type(error).__name__}: {error}"), LONGEST)
                self._report(f"the curves do not go to {self._name.kind} ({what}): the run goes on, and every "
                             f"{RETRY:g} s this is tried again")  # fmt: skip
            self._has_failed = True
            self.close()

    def _write(self, sink: Sink, run: RunFolder) -> None:
        found = self._read(run)
        if self._forget(sink, found):
            found = self._read(run)
        for step, numbers in found:
            if lacking := {name: each for name, each in numbers.items() if step not in sink.known.get(name, {})}:
                sink.log(step, lacking)
                for name, each in lacking.items():
                    sink.known.setdefault(name, {})[step] = each
        sink.flush()
        self._since = max([self._since, *(step + 1 for step, numbers in found if "fitness__mean" in numbers)])

    def _read(self, run: RunFolder) -> list[tuple[int, dict[str, float]]]:
        with run.read_transaction():
            return list(scalars_of(run, self._since))

    def _forget(self, sink: Sink, found: Sequence[tuple[int, dict[str, float]]]) -> bool:
        """Whether results were taken back (R33); then what the journal has no more is dropped from the record."""
        differing = [
            (step, name)
            for step, numbers in found
            for name, each in numbers.items()
            if (held := sink.known.get(name, {}).get(step)) is not None and not _equal(held, each)
        ]
        if not self._since:  # all of the journal was read
            there = {(step, name) for step, numbers in found for name in numbers}
            differing += [
                (step, name)
                for name, points in sink.known.items()
                for step in points
                if (step, name) not in there and name.startswith(OURS)
            ]
        if not differing:
            return False
        sink.rewind(min(step for step, _ in differing))
        for step, name in differing:
            sink.known.get(name, {}).pop(step, None)
        self._since = 0
        return True

    def close(self) -> None:
        """Close the record if it is open."""
        sink, self._sink = self._sink, None
        with suppress(BaseException):  # as above
            if sink is not None:
                sink.close()


def _equal(one: float, other: float) -> bool:
    """Whether two numbers are the same, one of them perhaps in single precision."""
    return math.isclose(one, other, rel_tol=1e-6, abs_tol=1e-12)
