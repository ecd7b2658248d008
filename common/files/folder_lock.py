"""A folder in which one process at a time may work."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dreamfleet.common.errors import DatasetError, UsageError


@contextmanager
def folder_lock(lock: Path, who: str, flag: str = "--data") -> Iterator[None]:
    """Hold the folder of the file `lock`, made if it is not there; `UsageError` while another `who` works in it.

    `flag` is the one that names another folder.
    """
    folder = lock.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = lock.open("w")
    except OSError as error:
        raise DatasetError(f"cannot write in {folder}: {error.strerror}; choose another {flag}") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(f"another {who} works in {folder}: stop it first") from None
        yield
