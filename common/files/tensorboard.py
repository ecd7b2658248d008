"""TensorBoard event files: scalars over steps. tensorboardX writes them, so torch is not needed. Pages: monitor.md."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.errors import MissingExtraError
from dreamfleet.common.files.atomic_write import reporting_write_errors

if TYPE_CHECKING:
    from tensorboardX.event_file_writer import EventsWriter

FILE_VERSION = "brain.Event:2"
EVENTS = "events.out.tfevents.*"  # names of the files
EXTRA = "pip install 'dreamfleet[export]'"  # docs/how-to/export.md has it too


class EventFileWriter:
    """One event file, written in the caller's thread.

    The library's own writer thread dies on a full disk, and closing it then blocks for ever.
    """

    def __init__(self, writer: EventsWriter) -> None:
        self._writer = writer

    def begin(self, step: int) -> None:
        """Start a session at `step`: TensorBoard discards points of earlier files from there on."""
        from tensorboardX.proto.event_pb2 import SessionLog

        self._write(step=step, file_version=FILE_VERSION)
        self._write(step=step, session_log=SessionLog(status=SessionLog.START))

    def add(self, step: int, **values: float) -> None:
        """Add scalars of one step by name, in one record; `__` in a name becomes TensorBoard's `/`."""
        from tensorboardX.proto.summary_pb2 import Summary
        from tensorboardX.summary import scalar

        each = (scalar(name.replace("__", "/"), value).value for name, value in values.items())
        self._write(step=step, summary=Summary(value=chain.from_iterable(each)))
        self._writer.flush()  # visible while the training runs

    def add_text(self, name: str, text: str) -> None:
        """Add a text, shown beside the curves."""
        from tensorboardX.summary import text as summary_of

        self._write(summary=summary_of(name, text))

    def _write(self, **fields: Any) -> None:
        from tensorboardX.proto.event_pb2 import Event

        self._writer.write_event(Event(wall_time=time.time(), **fields))


@contextmanager
def open_event_file(folder: Path, since: int | None = None) -> Iterator[EventFileWriter]:
    """Open a new event file in `folder`; TensorBoard discards points of earlier files from step `since` on.

    `MissingExtraError` if tensorboardX is not installed, `DreamfleetError` if the file cannot be written.
    """
    try:
        from tensorboardX.event_file_writer import EventsWriter
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"TensorBoard's events need the package {error.name!r}: {EXTRA}") from error
    with reporting_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        suffix = f".{time.time_ns()}"  # without it two writers within a second have the same name
        writer = EventsWriter(str(folder / "events"), suffix)
        try:
            events = EventFileWriter(writer)
            if since is not None:
                events.begin(since)
            yield events
            writer.flush()
        finally:
            with suppress(OSError):  # the write error was reported already
                writer.close()
