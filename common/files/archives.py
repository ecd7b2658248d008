"""Reading zip archives and `.npz` files from untrusted sources within bounds, and writing reproducible zips.

Every reader of a bundle, a controller, a rollout or an optimiser's state uses this module. Declared sizes are checked
before anything is unpacked, and unpacked sizes against the declared ones. Pickle is never loaded. Pages: security.md.
"""

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
_END, _END_64, _END_BYTES = b"PK\5\6", b"PK\6\7", 22  # end-of-archive record: mark, its zip64 locator's mark, length
_RECORD_64, _LOCATOR_BYTES, _RECORD_BYTES = b"PK\6\6", 20, 56  # the zip64 record before its locator
_DIRECTORY_BYTES = 512  # maximum average length of a directory entry
_ENCRYPTED = 1  # bit of a member's flags
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
    """An archive is damaged or out of bounds; the reader adds the file's name and the remedy."""


@dataclass(frozen=True)
class ArchiveLimits:
    """The most members of an archive, and the most unpacked bytes of them; `zip64` lets that form pass."""

    size: int
    members: int = 64
    zip64: bool = False


class Archive:
    """An open archive whose directory is within its limits."""

    def __init__(self, archive: ZipFile, limits: ArchiveLimits) -> None:
        self._archive = archive
        self._members = {each.filename: each for each in archive.infolist()}
        if len(self._members) < len(archive.infolist()):
            raise DamagedArchiveError("two of its members have the same name")
        if len(self._members) > limits.members:
            raise DamagedArchiveError(f"it has {len(self._members)} members, and at most {limits.members} are read")
        if (size := sum(each.file_size for each in self._members.values())) > limits.size:
            raise DamagedArchiveError(f"it unpacks to {size >> 20} MiB, and at most {limits.size >> 20} are read")

    @property
    def names(self) -> frozenset[str]:
        """The names of its members."""
        return frozenset(self._members)

    def read(self, name: str, max_bytes: int | None = None) -> bytes:
        """Read one member; `DamagedArchiveError` if it has more than `max_bytes` or not its declared size."""
        member = self._find_member(name, max_bytes)
        with self._archive.open(member) as file:
            data = file.read(member.file_size + 1)  # past its end: zipfile checks the checksum there
        if len(data) != member.file_size:
            raise DamagedArchiveError(f"{name} does not have its declared length")
        return data

    def _find_member(self, name: str, max_bytes: int | None) -> ZipInfo:
        if (member := self._members.get(name)) is None:
            raise DamagedArchiveError(f"it holds no {name}")
        if member.flag_bits & _ENCRYPTED:
            raise DamagedArchiveError(f"{name} is encrypted")
        if member.compress_type not in (ZIP_STORED, ZIP_DEFLATED):
            raise DamagedArchiveError(f"{name} has an unknown compression method")
        if max_bytes is not None and member.file_size > max_bytes:
            raise DamagedArchiveError(f"{name} unpacks to {member.file_size} bytes, and at most {max_bytes} are read")
        return member


@contextmanager
def open_archive(file: BinaryIO, limits: ArchiveLimits) -> Iterator[Archive]:
    """Open the archive in an open file; every fault of it, also inside the context, is a `DamagedArchiveError`."""
    try:
        _check_end(file, limits)
        with ZipFile(file) as archive:
            yield Archive(archive, limits)
    except DamagedArchiveError:
        raise
    except _ZIP_ERRORS as error:
        raise DamagedArchiveError(_describe_error(error)) from error


def read_arrays(source: Path | bytes, limits: ArchiveLimits, names: Iterable[str] | None = None) -> Arrays:
    """Read the arrays of an `.npz`, or only those of these `names`; `OSError` or `DamagedArchiveError` on failure."""
    with _open_source(source, limits) as file, open_archive(file, limits) as archive:
        wanted = [each.removesuffix(NPY) for each in archive.names] if names is None else names
        return {each: parse_array(archive.read(each + NPY), each) for each in wanted}


def parse_array(data: bytes, name: str = "it") -> NDArray[Any]:
    """Parse an `.npy` of numbers or text; `DamagedArchiveError` unless its length fits its header."""
    start, text = _header(data, name)
    found = _HEADER.fullmatch(text)
    if found is None:
        raise DamagedArchiveError(f"{name} is not an array of numbers or texts")
    shape = tuple(int(each) for each in found[3].split(",") if each.strip())
    try:
        dtype = np.dtype(found[1])
        if not dtype.itemsize or math.prod(shape) * dtype.itemsize != len(data) - start:
            raise DamagedArchiveError(f"{name} does not have the length in its header")
        flat = np.frombuffer(data, dtype, offset=start)
        array = flat.reshape(shape[::-1]).T if found[2] == "True" else flat.reshape(shape)
    except (TypeError, ValueError) as error:
        raise DamagedArchiveError(f"{name} is not an array of numbers or texts ({_describe_error(error)})") from error
    if dtype.kind == "U":
        _check_text(data[start:], dtype, name)
    return array.copy(order="K")  # own memory in the stored order


def _header(data: bytes, name: str) -> tuple[int, str]:
    """The offset of the data in an `.npy`, and the text of its header."""
    if data[:6] != _MAGIC or len(data) < 12:
        raise DamagedArchiveError(f"{name} is not an array")
    field = "<H" if data[6] == 1 else "<I"
    start = 8 + struct.calcsize(field)
    (length,) = struct.unpack_from(field, data, 8)
    if length > _MAX_HEADER or start + length > len(data):
        raise DamagedArchiveError(f"{name} has a header that is too long")
    return start + length, data[start : start + length].decode("latin-1")


def _check_text(data: bytes, dtype: np.dtype[Any], name: str) -> None:
    """`DamagedArchiveError` for invalid characters, which NumPy would report only on access."""
    try:
        data.decode("utf-32-be" if dtype.byteorder == ">" else "utf-32-le")
    except UnicodeError as error:
        raise DamagedArchiveError(f"{name} is not text") from error


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
    """Bound the directory before `zipfile` reads it whole. Only archives without comment pass."""
    size = file.seek(0, io.SEEK_END)
    file.seek(max(0, size - _END_BYTES - _LOCATOR_BYTES))
    tail = file.read(_END_BYTES + _LOCATOR_BYTES)
    end = tail[-_END_BYTES:]
    if size < _END_BYTES or end[:4] != _END or end[-2:] != b"\0\0":
        raise DamagedArchiveError("it does not end as an archive does")
    (directory,) = struct.unpack_from("<I", end, 12)
    if tail[:4] == _END_64 and size > len(end):
        if not limits.zip64:
            raise DamagedArchiveError(
                "it is in the form zip64, which only archives beyond 4 GiB need: write it again without"
            )
        file.seek(max(0, size - len(tail) - _RECORD_BYTES))
        record = file.read(_RECORD_BYTES)
        if record[:4] != _RECORD_64:
            raise DamagedArchiveError("it does not end as an archive does")
        (directory,) = struct.unpack_from("<Q", record, 40)
    if directory > limits.members * _DIRECTORY_BYTES:
        raise DamagedArchiveError("its directory is too long")


def _describe_error(error: Exception) -> str:
    """An exception's text in one line, or the name of its type."""
    return " ".join(str(error.args[0]).split()) if error.args else type(error).__name__
