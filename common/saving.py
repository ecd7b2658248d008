"""What a verb writes where `--out` says: looked at before minutes of work, then whole or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from dreamfleet.common.errors import DreamfleetError, UsageError
from dreamfleet.common.files import check_replaceable, is_folder, write_aside


def check_out(path: Path) -> None:
    """`UsageError` where no file can be written; its folder is made."""
    if is_folder(path):
        raise UsageError(f"--out {path} is a folder: name a file in it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise UsageError(f"--out {path}: its folder cannot be made ({error}): choose another") from error
    if not os.access(path.parent, os.W_OK):
        raise UsageError(f"--out {path}: its folder cannot be written in: choose another")
    try:
        check_replaceable(path)
    except OSError as error:
        raise UsageError(f"--out {path}: {error.strerror}: name another") from error


@contextmanager
def saving(path: Path) -> Iterator[BinaryIO]:
    """Open what `--out` names for writing; it is whole or not there."""
    with told(path), write_aside(path) as file:
        yield file


@contextmanager
def told(path: Path, flag: str = "--out") -> Iterator[None]:
    """What cannot be written at `path`, which `flag` names, is a `DreamfleetError`."""
    try:
        yield
    except OSError as error:
        raise DreamfleetError(f"cannot write {path}: {error.strerror}; make room or choose another {flag}") from error
