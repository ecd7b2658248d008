"""Places of bundles: those that ship with the package, whole or as deltas, and the user's cache."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from dreamfleet.common.artifacts.bundle import LIMITS, Bundle, hash_file, read_bytes_or_none
from dreamfleet.common.errors import BundleError, CacheError, UsageError
from dreamfleet.common.files.archives import DamagedArchiveError, open_archive, write_archive
from dreamfleet.common.files.atomic_write import reporting_unwritable_folder
from dreamfleet.common.files.locks import wait_for_lock
from dreamfleet.common.files.regular_files import open_append, open_regular, path_exists
from dreamfleet.common.schema.validation import MalformedError, from_plain

INT8_SUFFIX = "-int8"  # in the name of a shipped bundle: NAME rounded to eight bits
CACHE_REMEDY = "make room in the cache, or point $DREAMFLEET_CACHE elsewhere"
DELTA_SUFFIX, DELTA_MANIFEST = ".lean", "lean.json"
_MAX_DELTA_MANIFEST = 10_000  # bytes
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class DeltaManifest:
    """The manifest of a delta: a zip like a bundle, without the parts that another shipped bundle, its base, holds too.

    Rebuilding gives the original bundle to the byte.
    """

    sha256: str  # of the whole bundle's file, hexadecimal
    base: str  # name of the shipped bundle that holds the other parts
    parts: tuple[str, ...]  # all members of the whole bundle, in order


class BundleStore:
    """Bundles by hash: in a cache folder, or among those that ship with the package."""

    def __init__(self, root: Path) -> None:
        self._folder = root / "bundles"

    def find(self, sha256: str) -> Bundle | None:
        """The verified bundle of this hash, or `None`; a damaged copy in the cache is removed."""
        if (cached := self._find_cached(sha256)) is not None:
            return cached
        for path in shipped_bundles().values():
            if (data := read_bytes_or_none(path)) is not None and hashlib.sha256(data).hexdigest() == sha256:
                return Bundle.from_bytes(path, data, sha256)
        return next((self.rebuild(path) for path, delta in _shipped_deltas() if delta.sha256 == sha256), None)

    def _find_cached(self, sha256: str) -> Bundle | None:
        path = self._path(sha256)
        if (data := read_bytes_or_none(path)) is None:
            return None
        if hashlib.sha256(data).hexdigest() == sha256:
            return Bundle.from_bytes(path, data, sha256)
        with suppress(OSError):
            path.unlink(missing_ok=True)
        return None

    def rebuild(self, path: Path) -> Bundle:
        """The whole bundle of a shipped delta; it is assembled once, in the cache."""
        delta = _read_delta_manifest(path)
        base = shipped_bundles().get(delta.base)
        if base is None:
            raise BundleError(f"{path} needs the bundle {delta.base}, which does not ship: install dreamfleet again")
        with self.lock_download(delta.sha256) as partial:
            if (found := self._find_cached(delta.sha256)) is not None:
                return found
            members = {**_read_members(base), **_read_members(path)}
            if missing := [name for name in delta.parts if name not in members]:
                raise _damage_error(path, f"{', '.join(missing)} is in neither it nor {base.name}")
            with self.reporting_write_errors(), partial.open("wb") as file:
                write_archive(file, [(name, members[name]) for name in delta.parts])
            return self.finish_download(delta.sha256)

    @contextmanager
    def lock_download(self, sha256: str) -> Iterator[Path]:
        """Lock the download of a bundle; yields its partial file, which may hold the first bytes already.

        Blocks while another process of this host downloads it, so call `find` again inside.
        """
        partial = self._partial_path(sha256)
        with self.reporting_write_errors():
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            lock = open_append(partial.with_suffix(".lock"))
        with lock:
            wait_for_lock(lock)
            yield partial

    def finish_download(self, sha256: str) -> Bundle:
        """Verify a finished download and move it into the cache; `BundleError` and removal for a wrong one."""
        partial, path = self._partial_path(sha256), self._path(sha256)
        with self.reporting_write_errors():
            if (found := hash_file(partial)) != sha256:
                partial.unlink()
                raise BundleError(  # docs/how-to/troubleshooting.md has this text
                    f"the bundle arrived damaged: its hash is {found[:12]}..., not {sha256[:12]}...; try again"
                )
            partial.replace(path)
        return Bundle.open(path, sha256)

    def reporting_write_errors(self) -> AbstractContextManager[None]:
        """Turn an `OSError` while writing in the cache into a `CacheError`."""
        return reporting_unwritable_folder(self._folder, CACHE_REMEDY, CacheError)

    def _path(self, sha256: str) -> Path:
        return self._folder / f"{_check_sha256(sha256)}.zip"

    def _partial_path(self, sha256: str) -> Path:
        return self._folder / f"{_check_sha256(sha256)}.part"


def _check_sha256(sha256: str) -> str:
    """Return `sha256` if it is a hash, else raise `BundleError`: it comes from the network and names a file."""
    if not _SHA256.fullmatch(sha256):
        raise BundleError(f"{sha256!r} is not the hash of a bundle: the run's specification is damaged")
    return sha256


def default_cache() -> Path:
    """`$DREAMFLEET_CACHE`, else `dreamfleet` in the user's cache folder."""
    given = os.environ.get("DREAMFLEET_CACHE")
    if given:
        return Path(given)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dreamfleet"
    except RuntimeError as error:  # neither $HOME nor the user's entry names a folder
        raise UsageError("this user has no home folder: point $DREAMFLEET_CACHE at one for the cache") from error


def pretrained_folder() -> Path:
    """The folder of what ships: bundles as `NAME.zip`, controllers as `NAME.npz`."""
    return Path(str(files("dreamfleet.common"))) / "pretrained"


def shipped_bundles() -> dict[str, Path]:
    """The bundles that ship whole, by name."""
    return {path.stem: path for path in sorted(pretrained_folder().glob("*.zip"))}


def _shipped_deltas() -> Iterator[tuple[Path, DeltaManifest]]:
    for path in sorted(pretrained_folder().glob(f"*{DELTA_SUFFIX}")):
        yield path, _read_delta_manifest(path)


def _read_delta_manifest(path: Path) -> DeltaManifest:
    """`BundleError` if it is damaged."""
    try:
        with open_regular(path, LIMITS.size) as file, open_archive(file, LIMITS) as archive:
            return from_plain(DeltaManifest, json.loads(archive.read(DELTA_MANIFEST, _MAX_DELTA_MANIFEST)))
    except (OSError, DamagedArchiveError, ValueError, MalformedError, RecursionError) as error:
        raise _damage_error(path, error) from error


def _read_members(path: Path) -> dict[str, bytes]:
    try:
        with open_regular(path, LIMITS.size) as file, open_archive(file, LIMITS) as archive:
            return {name: archive.read(name) for name in archive.names}
    except (OSError, DamagedArchiveError) as error:
        raise _damage_error(path, error) from error


def _damage_error(path: Path, why: object) -> BundleError:
    return BundleError(f"{path} is damaged ({why}): install dreamfleet again")


def shipped_names() -> tuple[str, ...]:
    """The names of all bundles that ship."""
    return (*shipped_bundles(), *(path.stem for path, _ in _shipped_deltas()))


def describe_bundle(sha256: str) -> str:
    """Name a world model for an error text, by its hash and, if it ships, by its name; an empty hash is none."""
    if not sha256:
        return "no world model"
    named: list[str] = []
    with suppress(OSError, BundleError):  # a damaged file that ships is another error than this one
        named += [name for name, path in shipped_bundles().items() if hash_file(path) == sha256]
        named += [path.stem for path, delta in _shipped_deltas() if delta.sha256 == sha256]
    return f"the world model {named[0]} ({sha256[:12]})" if named else f"the world model {sha256[:12]}"


def find_bundle(name: str) -> Bundle:
    """A shipped bundle by name, or any bundle by path; `BundleError` if there is none.

    >>> from dreamfleet import find_bundle
    >>> find_bundle("tiny").manifest.task
    'car-racing'
    """
    shipped = shipped_bundles()
    if name in shipped:
        return Bundle.open(shipped[name])
    for path, _ in _shipped_deltas():
        if path.stem == name:
            return BundleStore(default_cache()).rebuild(path)
    if not path_exists(Path(name)):
        raise BundleError(f"no bundle {name!r}: give a file, or one that ships: {', '.join(shipped_names()) or 'none'}")
    return Bundle.open(Path(name))
