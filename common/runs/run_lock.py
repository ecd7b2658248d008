"""The lock on a run's folder: one process at a time writes, moves or deletes it. Pages: troubleshooting.md."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.common.files.atomic_write import reporting_unwritable_folder
from dreamfleet.common.files.locks import is_locked_exclusively, open_lock, try_lock
from dreamfleet.common.files.regular_files import open_regular

LOCK = "lock"
RETRY_PAUSES = (0.01, 0.05)  # seconds; `is_run_locked` holds the lock for an instant


@contextmanager
def run_lock(path: Path) -> Iterator[None]:
    """Hold the lock of the run in the folder `path`; `UsageError` while another process holds it.

    The folder is locked too, for somebody may remove the lock file by hand. The journal is not locked: closing
    a second descriptor of it would release SQLite's own locks.
    """
    with ExitStack() as stack:
        with reporting_unwritable_folder(path, "choose another --runs-dir", JournalError):
            file = stack.enter_context(open_lock(path / LOCK))
            folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, folder)
            _lock_or_raise(file.fileno(), path)
            with suppress(OSError):  # some network file systems lock files only
                _lock_or_raise(folder, path)
        yield


def is_run_locked(path: Path) -> bool:
    """Whether a process of this host holds the lock of the run in the folder `path`. Writes nothing."""
    with suppress(OSError), open_regular(path / LOCK) as file:
        return is_locked_exclusively(file)
    return False


def _lock_or_raise(descriptor: int, path: Path) -> None:
    if not try_lock(descriptor, RETRY_PAUSES):
        raise UsageError(f"run {path.name} is held by a live coordinator; stop it first")
