"""TensorBoard's event files: scalars over steps. Written by tensorboardX, so that no host needs torch for it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from dreamfleet.common.errors import MissingExtraError
from dreamfleet.common.saving import told

if TYPE_CHECKING:
    from tensorboardX import SummaryWriter

EXTRA = "pip install 'dreamfleet[export]'"


class Events:
    """One event file."""

    def __init__(self, writer: SummaryWriter) -> None:
        self._writer = writer

    def add(self, step: int, **values: float) -> None:
        """Scalars of one step by their names, in which `__` stands for TensorBoard's `/`."""
        for name, value in values.items():
            self._writer.add_scalar(name.replace("__", "/"), value, step)

    def add_text(self, name: str, text: str) -> None:
        """Text that stands beside the curves."""
        self._writer.add_text(name, text)


@contextmanager
def event_file(folder: Path, since: int | None = None) -> Iterator[Events]:
    """An event file in `folder`; points of earlier files from step `since` on count no more.

    `MissingExtraError` where tensorboardX is not installed.
    """
    try:
        from tensorboardX import SummaryWriter
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"TensorBoard's events need the package {error.name!r}: {EXTRA}") from error
    with told(folder):
        folder.mkdir(parents=True, exist_ok=True)
        own = f".{time.time_ns()}"  # the library's own name is equal for two writers within a second
        with SummaryWriter(str(folder), purge_step=since, filename_suffix=own) as writer:
            yield Events(writer)
