"""Opening untrusted paths: only regular files, up to a maximum size; and whether others may change them."""

import errno
import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any, BinaryIO


class _Readable(FileIO):
    """A file that never has nothing to read yet: some in /proc call themselves regular, and wait like a pipe."""

    def readinto(self, buffer: Any, /) -> int:
        found = super().readinto(buffer)
        if found is None:
            raise OSError(errno.EINVAL, "it is not a regular file")
        return found

    def readall(self) -> bytes:
        found = super().readall()
        if found is None:
            raise OSError(errno.EINVAL, "it is not a regular file")
        return found


@contextmanager
def open_regular(path: Path, max_bytes: int = sys.maxsize) -> Iterator[BufferedReader]:
    """Open a regular file of at most `max_bytes` for reading; `OSError` for anything else and for invalid names.

    Reading a pipe or a device might never end.
    """
    try:
        number = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except ValueError as error:  # a NUL, or half a surrogate pair
        raise OSError(errno.EINVAL, "no file can have this name") from error
    try:
        _check_regular_size(os.fstat(number), max_bytes)
    except OSError:
        os.close(number)
        raise
    raw: Any = _Readable(number)
    with BufferedReader(raw) as file:
        yield file


def open_append(path: Path) -> BinaryIO:
    """Open or create a regular file for appending; `OSError` for anything else.

    Symbolic links are not followed: in a folder that others can write, one could point to another file of the user.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    file = open(os.open(path, flags, 0o666), "ab")  # noqa: SIM115, PTH123 - the caller closes it
    try:
        _check_regular_size(os.fstat(file.fileno()), sys.maxsize)
    except OSError:
        file.close()
        raise
    return file


def check_regular(path: Path) -> None:
    """`OSError` unless `path` is a regular file. Does not open it.

    Closing a second descriptor of a file that SQLite has open would release SQLite's locks.
    """
    try:
        _check_regular_size(path.stat(), sys.maxsize)
    except ValueError as error:  # a NUL, or half a surrogate pair
        raise OSError(errno.EINVAL, "no file can have this name") from error


def check_replaceable(path: Path) -> None:
    """`OSError` if `path` exists and is not a regular file."""
    with suppress(FileNotFoundError):
        check_regular(path)


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Read a regular file of at most `max_bytes`; `OSError` for anything else."""
    with open_regular(path, max_bytes) as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:  # it has grown since
        raise OSError(errno.EFBIG, f"it is larger than {max_bytes} bytes")
    return data


def read_text(path: Path, max_bytes: int) -> str:
    """Read a UTF-8 text file of at most `max_bytes`; `OSError` for anything else."""
    try:
        return read_regular(path, max_bytes).decode()
    except UnicodeDecodeError as error:
        raise OSError(errno.EILSEQ, "it is not UTF-8 text") from error


def path_exists(path: Path) -> bool:
    """Whether `path` exists, dangling links included; False for an invalid name."""
    return os.path.lexists(path)


def is_file(path: Path) -> bool:
    """Whether `path` exists and is no folder; False for an invalid name."""
    return os.path.exists(path) and not os.path.isdir(path)  # noqa: PTH110, PTH112 - `Path` raises for some names


def is_folder(path: Path) -> bool:
    """Whether `path` is a folder; False for an invalid name."""
    return os.path.isdir(path)  # noqa: PTH112 - as above


def _check_regular_size(found: os.stat_result, max_bytes: int) -> None:
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder")
    if not stat.S_ISREG(found.st_mode):
        raise OSError(errno.EINVAL, "it is not a regular file")
    if found.st_size > max_bytes:
        raise OSError(errno.EFBIG, f"it is larger than {max_bytes} bytes")


def others_write(found: os.stat_result) -> bool:
    """Whether others may write there. A group is the user's alone if it has the user's number; spawn's agent.py too."""
    return bool(found.st_mode & (stat.S_IWOTH | (0 if found.st_gid == os.geteuid() else stat.S_IWGRP)))
