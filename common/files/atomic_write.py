"""Atomic writes, and checks of a verb's `--out` before it works for minutes. Pages: troubleshooting.md."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from dreamfleet.common.errors import DatasetError, DreamfleetError, UsageError, is_disk_full
from dreamfleet.common.files.regular_files import check_replaceable, is_folder


def check_output_path(path: Path) -> None:
    """Create the folder of `path`; `UsageError` if no file can be written there."""
    if is_folder(path):
        raise UsageError(f"--out {path} is a folder: name a file in it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise UsageError(f"--out {path}: its folder cannot be created ({error}): choose another") from error
    if not os.access(path.parent, os.W_OK):
        raise UsageError(f"--out {path}: its folder is not writable: choose another")
    try:
        check_replaceable(path)
    except OSError as error:
        raise UsageError(f"--out {path}: {error.strerror}: choose another") from error


@contextmanager
def open_output(path: Path) -> Iterator[BinaryIO]:
    """Open the file that `--out` names for an atomic write; `DreamfleetError` on failure."""
    with reporting_write_errors(path), atomic_write(path) as file:
        yield file


@contextmanager
def reporting_write_errors(path: Path, flag: str = "--out") -> Iterator[None]:
    """Turn an `OSError` while writing `path` into a `DreamfleetError`; `flag` names the path on the command line."""
    try:
        yield
    except OSError as error:
        remedy = "make room or choose" if is_disk_full(error) else "choose"
        raise DreamfleetError(f"cannot write {path}: {error.strerror}; {remedy} another {flag}") from error


@contextmanager
def reporting_unwritable_folder(
    folder: Path, remedy: str, error_type: type[DreamfleetError] = DatasetError
) -> Iterator[None]:
    """Turn an `OSError` while writing in `folder` into an `error_type` that ends with the `remedy`."""
    try:
        yield
    except OSError as error:
        raise error_type(f"cannot write in {folder}: {error.strerror}; {remedy}") from error


@contextmanager
def atomic_write(path: Path, *, private: bool = False) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`; on success it is synced and replaces `path`, on failure it is deleted.

    A `private` file has mode 600 from the first byte on. The folder is synced too, so that the new name survives a
    power cut. `OSError` if `path` exists and is not a regular file: a device would be replaced by a file.
    """
    check_replaceable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        if private:
            aside.unlink(missing_ok=True)  # a leftover may have another mode
        with open_new(aside) if private else aside.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
        fsync_path(path.parent)
    finally:
        aside.unlink(missing_ok=True)


def open_new(path: Path) -> BinaryIO:
    """Create a file with mode 600 and open it for writing; `FileExistsError` if it exists."""
    return open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "wb")  # noqa: PTH123


def fsync_path(path: Path) -> None:
    """Sync a file's bytes, or the names in a folder, to disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
