"""Write a training's loss curve to disk, and optionally as TensorBoard events."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from dreamfleet.common.files.tensorboard import open_event_file
from dreamfleet.worker.training.data.data_folder import explain_write_errors

AddPoint = Callable[..., None]  # `point(update=120, error=0.3)`


@contextmanager
def open_loss_curve(path: Path, events: Path | None, update: int) -> Iterator[AddPoint]:
    """Yield a function that appends points to the curve; `events` is a folder for TensorBoard events, or `None`.

    The training resumes after `update`: events beyond it are superseded. `MissingExtraError` if events cannot be
    written.
    """
    if events is None:
        yield lambda **values: append_point(path, **values)
        return
    with open_event_file(events / path.stem, since=update + 1) as file:

        def point(*, update: int, **values: float) -> None:
            append_point(path, update=update, **values)
            file.add(update, **{f"loss__{name}": value for name, value in values.items()})

        yield point


def append_point(path: Path, **values: float) -> None:
    """Append a point as a line of JSON, whole or not at all; `DatasetError` if it cannot be written."""
    line = (json.dumps({name: round(value, 6) for name, value in values.items()}) + "\n").encode()
    with explain_write_errors(path), path.open("ab", buffering=0) as file:
        end = file.seek(0, 2)
        try:
            while line:
                line = line[file.write(line) :]
        except OSError:
            file.truncate(end)
            raise
