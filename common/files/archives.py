"""Zip archives and `.npz` files that people pass around, read within bounds: none asks for more than it may have.

Every reader of a bundle, a controller, a rollout or an optimiser's state goes through here. What an archive declares is
bounded before it is read, and what is read is what was declared. No pickle, no code, no file beside it.
"""

from __future__ import annotations

import io
import math
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import ZIP_DEFLATED, ZIP_STORED, BadZipFile, ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.files.regular_files import open_regular

Arrays = dict[str, NDArray[Any]]
NPY = ".npy"
_END, _END_64, _END_BYTES = b"PK\5\6", b"PK\6\7", 22  # of the record that closes an archive, and of its locator
_DIRECTORY_BYTES = 512  # of one member's entry at most, on average
_ENCRYPTED = 1
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest date of a zip
_MAGIC = b"\x93NUMPY"
_MAX_HEADER = 10_000
_HEADER = re.compile(
    r"\{'descr': '([<>|=][fiubU]\d{1,9})', 'fortran_order': (False|True), "
    r"'shape': \((|\d{1,18},|\d{1,18}(?:, \d{1,18}){1,31})\), \}\s*",
    re.ASCII,
)
_ZIP_ERRORS = (BadZipFile, zlib.error, struct.error, EOFError, KeyError, NotImplementedError, RuntimeError, ValueError,
           OverflowError)  # fmt: skip


class DamagedArchiveError(ValueError):
    """What is wrong with an archive, in a few words; its reader says which file it is, and the remedy."""


@dataclass(frozen=True)
class ArchiveLimits:
    """How much an archive may hold: members, and bytes of them all when unpacked."""

    size: int
    members: int = 64


class Archive:
    """An archive whose directory has been looked at."""

    def __init__(self, archive: ZipFile, limits: ArchiveLimits) -> None:
        self._archive = archive
        self._members = {each.filename: each for each in archive.infolist()}
        if len(self._members) < len(archive.infolist()):
            raise DamagedArchiveError("two of its members have one name")
        if len(self._members) > limits.members:
            raise DamagedArchiveError(f"it has {len(self._members)} members, {limits.members} at most are read")
        if (size := sum(each.file_size for each in self._members.values())) > limits.size:
            raise DamagedArchiveError(f"it unpacks to {size >> 20} MiB, {limits.size >> 20} at most are read")

    @property
    def names(self) -> frozenset[str]:
        """Names of its members."""
        return frozenset(self._members)

    def read(self, name: str, most: int | None = None) -> bytes:
        """The bytes of one member, no more than were declared and no more than `most`."""
        member = self._find_member(name, most)
        with self._archive.open(member) as file:
            data = file.read(member.file_size + 1)  # to its end, where its checksum is looked at
        if len(data) != member.file_size:
            raise DamagedArchiveError(f"{name} is not as long as it says")
        return data

    def _find_member(self, name: str, most: int | None) -> ZipInfo:
        if (member := self._members.get(name)) is None:
            raise DamagedArchiveError(f"it holds no {name}")
        if member.flag_bits & _ENCRYPTED:
            raise DamagedArchiveError(f"{name} is encrypted")
        if member.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
            raise DamagedArchiveError(f"{name} is packed in an unknown way")
        if most is not None and member.file_size > most:
            raise DamagedArchiveError(f"{name} unpacks to {member.file_size} bytes, {most} at most are read")
        return member


@contextmanager
def open_archive(file: BinaryIO, limits: ArchiveLimits) -> Iterator[Archive]:
    """An archive in an open file; `DamagedArchiveError` for whatever is wrong with it, also while it is read."""
    try:
        _check_end(file, limits)
        with ZipFile(file) as archive:
            yield Archive(archive, limits)
    except DamagedArchiveError:
        raise
    except _ZIP_ERRORS as error:
        raise DamagedArchiveError(_describe_error(error)) from error


def read_arrays(source: Path | bytes, limits: ArchiveLimits, names: Iterable[str] | None = None) -> Arrays:
    """The arrays of an `.npz`, or those of these `names`; `OSError` or `DamagedArchiveError` says why not."""
    with _open_source(source, limits) as file, open_archive(file, limits) as archive:
        wanted = [each.removesuffix(NPY) for each in archive.names] if names is None else names
        return {each: parse_array(archive.read(each + NPY), each) for each in wanted}


def parse_array(data: bytes, name: str = "it") -> NDArray[Any]:
    """The array in the bytes of an `.npy`: of numbers or texts, exactly as long as its header says."""
    start, text = _header(data, name)
    found = _HEADER.fullmatch(text)
    if found is None:
        raise DamagedArchiveError(f"{name} is no array of numbers or texts")
    shape = tuple(int(each) for each in found[3].split(",") if each.strip())
    try:
        kind = np.dtype(found[1])
        if not kind.itemsize or math.prod(shape) * kind.itemsize != len(data) - start:
            raise DamagedArchiveError(f"{name} is not as long as its header says")
        flat = np.frombuffer(data, kind, offset=start)
        array = flat.reshape(shape[::-1]).T if found[2] == "True" else flat.reshape(shape)
    except (TypeError, ValueError) as error:
        raise DamagedArchiveError(f"{name} is no array of numbers or texts ({_describe_error(error)})") from error
    if kind.kind == "U":
        _check_text(data[start:], kind, name)
    return array.copy(order="K")  # of its own memory, in the order in which it was kept


def _header(data: bytes, name: str) -> tuple[int, str]:
    """Where the numbers begin, and the text that says what they are."""
    if data[:6] != _MAGIC or len(data) < 12:
        raise DamagedArchiveError(f"{name} is no array")
    field = "<H" if data[6] == 1 else "<I"
    start = 8 + struct.calcsize(field)
    (length,) = struct.unpack_from(field, data, 8)
    if length > _MAX_HEADER or start + length > len(data):
        raise DamagedArchiveError(f"{name} has a header that is too long")
    return start + length, data[start : start + length].decode("latin-1")


def _check_text(data: bytes, kind: np.dtype[Any], name: str) -> None:
    """NumPy itself looks at a text's characters only once it is asked for."""
    try:
        data.decode("utf-32-be" if kind.byteorder == ">" else "utf-32-le")
    except UnicodeError as error:
        raise DamagedArchiveError(f"{name} is no text") from error


def write_archive(file: BinaryIO | Path, members: Iterable[tuple[str, bytes]], compression: int = ZIP_STORED) -> None:
    """Write a zip of these members without dates: equal members give equal bytes."""
    with ZipFile(file, "w", compression) as archive:
        for name, data in members:
            archive.writestr(ZipInfo(name, _EPOCH), data, compression)


@contextmanager
def _open_source(source: Path | bytes, limits: ArchiveLimits) -> Iterator[BinaryIO]:
    if isinstance(source, bytes):
        yield io.BytesIO(source)
        return
    with open_regular(source, limits.size) as file:
        yield file


def _check_end(file: BinaryIO, limits: ArchiveLimits) -> None:
    """Bound the directory, which `zipfile` reads whole: an archive of ours has no comment and is no `zip64`."""
    size = file.seek(0, io.SEEK_END)
    file.seek(max(0, size - _END_BYTES - 20))
    tail = file.read(_END_BYTES + 20)
    end = tail[-_END_BYTES:]
    if size < _END_BYTES or end[:4] != _END or end[-2:] != b"\0\0":
        raise DamagedArchiveError("it does not end as an archive does")
    if tail[:4] == _END_64 and size > len(end):
        raise DamagedArchiveError("it is larger than an archive of this kind may be")
    (directory,) = struct.unpack_from("<I", end, 12)
    if directory > limits.members * _DIRECTORY_BYTES:
        raise DamagedArchiveError("its directory is too long")


def _describe_error(error: Exception) -> str:
    """What an exception says, or what it is."""
    return " ".join(str(error.args[0]).split()) if error.args else type(error).__name__
