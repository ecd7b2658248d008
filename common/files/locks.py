"""Advisory locks (flock) on files and folders. The kernel releases a lock when its holder ends."""

import errno
import fcntl
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import reporting_unwritable_folder
from dreamfleet.common.files.regular_files import open_append


@contextmanager
def folder_lock(lock: Path, who: str, flag: str = "--data") -> Iterator[None]:
    """Hold the lock file `lock`; create its folder if needed. `UsageError` while another `who` works in the folder.

    `flag` is the command-line flag that chooses another folder.
    """
    folder = lock.parent
    with reporting_unwritable_folder(folder, f"choose another {flag}"):
        folder.mkdir(parents=True, exist_ok=True)
        file = open_lock(lock)
    with file:
        if not try_lock(file):
            raise UsageError(f"another {who} works in {folder}: stop it first")
        yield


def open_lock(path: Path) -> BinaryIO:
    """Open or create a lock file, whose content stays; `UsageError` for a link, a folder, a pipe or a device."""
    try:
        return open_append(path)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.EISDIR, errno.EINVAL, errno.ENXIO):
            raise
        why = "it is a symbolic link" if error.errno == errno.ELOOP else error.strerror
        raise UsageError(f"{path} cannot be the lock file: {why}; remove it") from error


def try_lock(file: IO[Any] | int, retry_pauses: Sequence[float] = ()) -> bool:
    """Lock an open file or folder for this process alone; False while another process holds it.

    Tries again after each of `retry_pauses`, in seconds.
    """
    for pause in (0.0, *retry_pauses):
        time.sleep(pause)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue
        return True
    return False


def wait_for_lock(file: IO[Any]) -> None:
    """Lock an open file for this process alone; blocks while another process holds it."""
    fcntl.flock(file, fcntl.LOCK_EX)


def is_locked_exclusively(file: IO[Any]) -> bool:
    """Whether another process holds the lock of an open file. Takes a shared lock; close the file to release it."""
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    return False
