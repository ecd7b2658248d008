"""TensorBoard's event files: scalars over steps. Written by tensorboardX, so that no host needs torch for it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.errors import MissingExtraError
from dreamfleet.common.files.atomic_write import reporting_write_errors

if TYPE_CHECKING:
    from tensorboardX.event_file_writer import EventsWriter

FILE_VERSION = "brain.Event:2"  # of the format
EXTRA = "pip install 'dreamfleet[export]'"


class EventFileWriter:
    """One event file.

    It is written in the caller's thread: the library's own ends on a full disk, and would be waited for for ever.
    """

    def __init__(self, writer: EventsWriter) -> None:
        self._writer = writer

    def begin(self, step: int) -> None:
        """Points of earlier files from `step` on count no more."""
        from tensorboardX.proto.event_pb2 import Event, SessionLog

        self._write(Event(step=step, file_version=FILE_VERSION))
        self._write(Event(step=step, session_log=SessionLog(status=SessionLog.START)))

    def add(self, step: int, **values: float) -> None:
        """Scalars of one step by their names, in which `__` stands for TensorBoard's `/`."""
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.summary import scalar

        for name, value in values.items():
            self._write(Event(step=step, summary=scalar(name.replace("__", "/"), value)))
        self._writer.flush()  # so that they are seen while a training goes on

    def add_text(self, name: str, text: str) -> None:
        """Text that stands beside the curves."""
        from tensorboardX.proto.event_pb2 import Event
        from tensorboardX.summary import text as summary_of

        self._write(Event(summary=summary_of(name, text)))

    def _write(self, event: Any) -> None:
        event.wall_time = time.time()
        self._writer.write_event(event)


@contextmanager
def open_event_file(folder: Path, since: int | None = None) -> Iterator[EventFileWriter]:
    """An event file in `folder`; points of earlier files from step `since` on count no more.

    `MissingExtraError` where tensorboardX is not installed, `DreamfleetError` where there is no room.
    """
    try:
        from tensorboardX.event_file_writer import EventsWriter
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"TensorBoard's events need the package {error.name!r}: {EXTRA}") from error
    with reporting_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        own = f".{time.time_ns()}"  # the library's own name is equal for two writers within a second
        writer = EventsWriter(str(folder / "events"), own)
        try:
            events = EventFileWriter(writer)
            if since is not None:
                events.begin(since)
            yield events
            writer.flush()
        finally:
            with suppress(OSError):  # what could not be written was told
                writer.close()
