"""Where bundles lie: those that ship with the package, whole or lean, and the cache of this user."""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.resources import files
from pathlib import Path

from dreamfleet.common.artifacts.bundle import LIMITS, MANIFEST, Bundle, hash_file, read_bytes_or_none
from dreamfleet.common.artifacts.delta_bundle import (
    DELTA_SUFFIX,
    DeltaManifest,
    read_delta_manifest,
    rebuild_bundle,
    write_delta,
)
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.files.regular_files import open_append, path_exists

_SHA256 = re.compile(r"[0-9a-f]{64}")


def write_shipped_delta(bundle: Bundle, base: str, path: Path) -> None:
    """Write the bundle as one that ships beside the one of the name `base`, without the parts that it has in common."""
    lean = DeltaManifest(bundle.sha256, base, (MANIFEST, *sorted(bundle.manifest.parts)))
    write_delta(path, lean, bundle.path, shipped_bundles()[base], LIMITS)


class BundleStore:
    """Bundles by hash in a cache folder; what ships with the package is found too."""

    def __init__(self, root: Path) -> None:
        self._folder = root / "bundles"

    def find(self, sha256: str) -> Bundle | None:
        """The verified bundle of this hash; a damaged cached copy is removed, so that it is fetched again."""
        if (cached := self._find_cached(sha256)) is not None:
            return cached
        for path in shipped_bundles().values():
            if (data := read_bytes_or_none(path)) is not None and hashlib.sha256(data).hexdigest() == sha256:
                return Bundle.from_bytes(path, data, sha256)
        return next((self.rebuild(path) for path, lean in _shipped_deltas() if lean.sha256 == sha256), None)

    def _find_cached(self, sha256: str) -> Bundle | None:
        path = self._path(sha256)
        if (data := read_bytes_or_none(path)) is None:
            return None
        if hashlib.sha256(data).hexdigest() == sha256:
            return Bundle.from_bytes(path, data, sha256)
        with suppress(OSError):  # looked at, and wrong; one that another process completes meanwhile must stay
            path.unlink(missing_ok=True)
        return None

    def rebuild(self, path: Path) -> Bundle:
        """The whole bundle of a lean file that ships; put together here once."""
        lean = read_delta_manifest(path, LIMITS)
        base = shipped_bundles().get(lean.base)
        if base is None:
            raise BundleError(f"{path} needs the bundle {lean.base}, which does not ship: install dreamfleet again")
        with self.lock_download(lean.sha256) as partial:
            if (found := self._find_cached(lean.sha256)) is not None:
                return found
            try:
                with partial.open("wb") as file:
                    rebuild_bundle(path, base, file, LIMITS)
            except OSError as error:
                raise self.write_error(error) from error
            return self.finish_download(lean.sha256)

    @contextmanager
    def lock_download(self, sha256: str) -> Iterator[Path]:
        """Hold the right to download: where the bundle grows; what is there already is its beginning.

        Waits while another process of this host downloads it; look with `find` again before you do.
        """
        partial = self._partial_path(sha256)
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            lock = open_append(partial.with_suffix(".lock"))
        except OSError as error:
            raise self.write_error(error) from error
        with lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield partial

    def finish_download(self, sha256: str) -> Bundle:
        """Verify a finished download and give it its name; a wrong one is removed."""
        partial, path = self._partial_path(sha256), self._path(sha256)
        try:
            if (found := hash_file(partial)) != sha256:
                partial.unlink()
                raise BundleError(
                    f"the bundle arrived damaged: its hash is {found[:12]}..., not {sha256[:12]}...; try again"
                )
            partial.replace(path)
        except OSError as error:
            raise self.write_error(error) from error
        return Bundle.open(path, sha256)

    def write_error(self, error: OSError) -> BundleError:
        """What to say where the folder takes nothing."""
        return BundleError(
            f"cannot write in {self._folder}: {error.strerror}; make room there, or point $DREAMFLEET_CACHE elsewhere"
        )

    def _path(self, sha256: str) -> Path:
        return self._folder / f"{_check_sha256(sha256)}.zip"

    def _partial_path(self, sha256: str) -> Path:
        return self._folder / f"{_check_sha256(sha256)}.part"


def _check_sha256(sha256: str) -> str:
    """A hash that comes over the wire becomes part of a path: it must be one."""
    if not _SHA256.fullmatch(sha256):
        raise BundleError(f"{sha256!r} is no hash of a bundle: the run's specification is damaged")
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
    """The lean files that ship."""
    for path in sorted(pretrained_folder().glob(f"*{DELTA_SUFFIX}")):
        yield path, read_delta_manifest(path, LIMITS)


def shipped_names() -> tuple[str, ...]:
    """The names of all bundles that ship."""
    return (*shipped_bundles(), *(path.stem for path, _ in _shipped_deltas()))


def find_bundle(name: str) -> Bundle:
    """A shipped bundle by name, or any by path.

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
