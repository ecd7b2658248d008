"""Files of others, which may be anything: only regular files are opened, within bounds."""

from __future__ import annotations

import errno
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO


@contextmanager
def open_regular(path: Path, most: int = sys.maxsize) -> Iterator[BufferedReader]:
    """Open a file of at most so many bytes for reading; `OSError` for what is none.

    A pipe or a device is none: to read it might never end. A name that no file can have is an `OSError` too.
    """
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:  # a NUL, or half a surrogate pair
        raise OSError(errno.EINVAL, "no file can have this name") from error
    with open(number, "rb") as file:  # noqa: PTH123 - it is open
        _check_regular_size(os.fstat(number), most)
        yield file


def open_append(path: Path) -> BinaryIO:
    """Open a file to append to it, which is made if it is not there; `OSError` for what is none.

    No link is followed: in a folder that others may write in, it would lead to a file of the user's own.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    file = open(os.open(path, flags, 0o666), "ab")  # noqa: SIM115, PTH123 - it is open, and the caller's
    try:
        _check_regular_size(os.fstat(file.fileno()), sys.maxsize)
    except OSError:
        file.close()
        raise
    return file


def check_regular(path: Path) -> None:
    """`OSError` for what is no file that can be read to its end; it is looked at, and not opened.

    Where SQLite has a file open, closing another descriptor of it would end SQLite's locks.
    """
    try:
        _check_regular_size(path.stat(), sys.maxsize)
    except ValueError as error:  # a NUL, or half a surrogate pair
        raise OSError(errno.EINVAL, "no file can have this name") from error


def check_replaceable(path: Path) -> None:
    """`OSError` where there is something that is no file."""
    with suppress(FileNotFoundError):
        check_regular(path)


def read_regular(path: Path, most: int) -> bytes:
    """All bytes of a file of at most so many; `OSError` for what is none."""
    with open_regular(path, most) as file:
        data = file.read(most + 1)
    if len(data) > most:  # it grew meanwhile
        raise OSError(errno.EFBIG, f"it is larger than {most} bytes")
    return data


def read_text(path: Path, most: int) -> str:
    """A text file of at most so many bytes; `OSError` for what is none, also if it is not UTF-8."""
    try:
        return read_regular(path, most).decode()
    except UnicodeDecodeError as error:
        raise OSError(errno.EILSEQ, "it is no text in UTF-8") from error


def path_exists(path: Path) -> bool:
    """Whether there is anything; a name that no file can have is no error."""
    return os.path.lexists(path)


def is_file(path: Path) -> bool:
    """Whether there is a file, or what one might be read from; a name that no file can have is no error."""
    return os.path.exists(path) and not os.path.isdir(path)  # noqa: PTH110, PTH112 - `Path` raises for some names


def is_folder(path: Path) -> bool:
    """Whether there is a folder; a name that no folder can have is no error."""
    return os.path.isdir(path)  # noqa: PTH112 - as above


def _check_regular_size(found: os.stat_result, most: int) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder")
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "it is no regular file")
    if found.st_size > most:
        raise OSError(errno.EFBIG, f"it is larger than {most} bytes")
