"""A bundle that ships beside another one: parts that both hold are kept once, in the other one's file.

A lean file is a stored zip, as a bundle is: the bundle's manifest, the parts that are its own, and which bundle has the
others. What is put together is the bundle as it was frozen, to the byte, for its hash is told too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

from dreamfleet.common.errors import BundleError
from dreamfleet.common.files.archives import ArchiveLimits, DamagedArchiveError, open_archive, write_archive
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.files.regular_files import open_regular

DELTA_SUFFIX = ".lean"
DELTA_MANIFEST = "lean.json"
_MAX_ABOUT = 10_000  # bytes


@dataclass(frozen=True)
class DeltaManifest:
    """What a lean file says of itself."""

    sha256: str  # of the whole bundle's file, hexadecimal
    base: str  # name of the bundle that ships whole and holds the other parts
    parts: tuple[str, ...]  # all members of the whole bundle, in order


def write_delta(path: Path, lean: DeltaManifest, whole: Path, base: Path, limits: ArchiveLimits) -> None:
    """Write what of the bundle's file `whole` the file `base` does not hold."""
    members, theirs = _members(whole, limits), _members(base, limits)
    own = [(name, members[name]) for name in lean.parts if theirs.get(name) != members[name]]
    with atomic_write(path) as file:
        write_archive(file, [(DELTA_MANIFEST, json.dumps(asdict(lean)).encode()), *own])


def read_delta_manifest(path: Path, limits: ArchiveLimits) -> DeltaManifest:
    """What a lean file says of itself; `BundleError` if it is damaged."""
    try:
        with open_regular(path, limits.size) as file, open_archive(file, limits) as archive:
            plain = json.loads(archive.read(DELTA_MANIFEST, _MAX_ABOUT))
        return DeltaManifest(str(plain["sha256"]), str(plain["base"]), tuple(map(str, plain["parts"])))
    except (OSError, DamagedArchiveError, ValueError, TypeError, KeyError) as error:
        raise _damage_error(path, error) from error


def rebuild_bundle(path: Path, base: Path, file: BinaryIO, limits: ArchiveLimits) -> None:
    """Write the whole bundle of a lean file; `BundleError` where a part is in neither."""
    lean = read_delta_manifest(path, limits)
    members: Mapping[str, bytes] = {**_members(base, limits), **_members(path, limits)}
    if missing := [name for name in lean.parts if name not in members]:
        raise _damage_error(path, f"{', '.join(missing)} is in neither it nor {base.name}")
    write_archive(file, [(name, members[name]) for name in lean.parts])


def _members(path: Path, limits: ArchiveLimits) -> dict[str, bytes]:
    """Everything that a zip holds."""
    try:
        with open_regular(path, limits.size) as file, open_archive(file, limits) as archive:
            return {name: archive.read(name) for name in archive.names}
    except (OSError, DamagedArchiveError) as error:
        raise _damage_error(path, error) from error


def _damage_error(path: Path, why: object) -> BundleError:
    return BundleError(f"{path} is damaged ({why}): install dreamfleet again")
