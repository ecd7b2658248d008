"""Files of a training where the disk takes no more."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dreamfleet.common.errors import DatasetError

FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)


@contextmanager
def explain_write_errors(path: Path) -> Iterator[None]:
    """What cannot be written at `path` is a `DatasetError` that says what is kept and how to go on."""
    try:
        yield
    except OSError as error:
        raise DatasetError(
            f"cannot write {path}: {error.strerror}; nothing that was saved before is lost: "
            f"{'make it writable' if error.errno in FORBIDDEN else 'make room there'}, and the same command (without "
            "--new, where it had that) goes on"
        ) from error
