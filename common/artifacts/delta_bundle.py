"""Delta bundles: a bundle without the parts that another shipped bundle, its base, holds too.

A delta is an uncompressed zip like a bundle: a delta manifest, the bundle's manifest, and its own parts. Rebuilding
gives the original bundle to the byte; the delta manifest holds its hash.
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
_MAX_DELTA_MANIFEST = 10_000  # bytes


@dataclass(frozen=True)
class DeltaManifest:
    """A delta's manifest."""

    sha256: str  # of the whole bundle's file, hexadecimal
    base: str  # name of the shipped bundle that holds the other parts
    parts: tuple[str, ...]  # all members of the whole bundle, in order


def write_delta(path: Path, delta: DeltaManifest, whole: Path, base: Path, limits: ArchiveLimits) -> None:
    """Write the parts of the bundle's file `whole` that the file `base` does not hold."""
    members, base_members = _members(whole, limits), _members(base, limits)
    own = [(name, members[name]) for name in delta.parts if base_members.get(name) != members[name]]
    with atomic_write(path) as file:
        write_archive(file, [(DELTA_MANIFEST, json.dumps(asdict(delta)).encode()), *own])


def read_delta_manifest(path: Path, limits: ArchiveLimits) -> DeltaManifest:
    """Read a delta's manifest; `BundleError` if it is damaged."""
    try:
        with open_regular(path, limits.size) as file, open_archive(file, limits) as archive:
            plain = json.loads(archive.read(DELTA_MANIFEST, _MAX_DELTA_MANIFEST))
        return DeltaManifest(str(plain["sha256"]), str(plain["base"]), tuple(map(str, plain["parts"])))
    except (OSError, DamagedArchiveError, ValueError, TypeError, KeyError) as error:
        raise _damage_error(path, error) from error


def rebuild_bundle(path: Path, base: Path, file: BinaryIO, limits: ArchiveLimits) -> None:
    """Write the whole bundle of a delta to `file`; `BundleError` if a part is in neither of the two files."""
    delta = read_delta_manifest(path, limits)
    members: Mapping[str, bytes] = {**_members(base, limits), **_members(path, limits)}
    if missing := [name for name in delta.parts if name not in members]:
        raise _damage_error(path, f"{', '.join(missing)} is in neither it nor {base.name}")
    write_archive(file, [(name, members[name]) for name in delta.parts])


def _members(path: Path, limits: ArchiveLimits) -> dict[str, bytes]:
    """All members of a zip, by name."""
    try:
        with open_regular(path, limits.size) as file, open_archive(file, limits) as archive:
            return {name: archive.read(name) for name in archive.names}
    except (OSError, DamagedArchiveError) as error:
        raise _damage_error(path, error) from error


def _damage_error(path: Path, why: object) -> BundleError:
    return BundleError(f"{path} is damaged ({why}): install dreamfleet again")
