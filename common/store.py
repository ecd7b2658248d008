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

from dreamfleet.common.bundle import LIMITS, MANIFEST, Bundle, bytes_of, hash_file
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.files import is_there, open_growing
from dreamfleet.common.lean import SUFFIX, Lean, put_together, read_lean, write_lean

_SHA256 = re.compile(r"[0-9a-f]{64}")


def ship_lean(bundle: Bundle, base: str, path: Path) -> None:
    """Write the bundle as one that ships beside the one of the name `base`, without the parts that it has in common."""
    lean = Lean(bundle.sha256, base, (MANIFEST, *sorted(bundle.manifest.parts)))
    write_lean(path, lean, bundle.path, shipped_bundles()[base], LIMITS)


class BundleStore:
    """Bundles by hash in a cache folder; what ships with the package is found too."""

    def __init__(self, root: Path) -> None:
        self._folder = root / "bundles"

    def find(self, sha256: str) -> Bundle | None:
        """The verified bundle of this hash; a damaged cached copy is removed, so that it is fetched again."""
        if (cached := self._cached(sha256)) is not None:
            return cached
        for path in shipped_bundles().values():
            if (data := bytes_of(path)) is not None and hashlib.sha256(data).hexdigest() == sha256:
                return Bundle.of(path, data, sha256)
        return next((self.grow(path) for path, lean in _leans() if lean.sha256 == sha256), None)

    def _cached(self, sha256: str) -> Bundle | None:
        path = self._path(sha256)
        if (data := bytes_of(path)) is None:
            return None
        if hashlib.sha256(data).hexdigest() == sha256:
            return Bundle.of(path, data, sha256)
        with suppress(OSError):  # looked at, and wrong; one that another process completes meanwhile must stay
            path.unlink(missing_ok=True)
        return None

    def grow(self, path: Path) -> Bundle:
        """The whole bundle of a lean file that ships; put together here once."""
        lean = read_lean(path, LIMITS)
        base = shipped_bundles().get(lean.base)
        if base is None:
            raise BundleError(f"{path} needs the bundle {lean.base}, which does not ship: install dreamfleet again")
        with self.downloading(lean.sha256) as partial:
            if (found := self._cached(lean.sha256)) is not None:
                return found
            try:
                with partial.open("wb") as file:
                    put_together(path, base, file, LIMITS)
            except OSError as error:
                raise self.unwritable(error) from error
            return self.complete(lean.sha256)

    @contextmanager
    def downloading(self, sha256: str) -> Iterator[Path]:
        """Hold the right to download: where the bundle grows; what is there already is its beginning.

        Waits while another process of this host downloads it; look with `find` again before you do.
        """
        partial = self._partial(sha256)
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            lock = open_growing(partial.with_suffix(".lock"))
        except OSError as error:
            raise self.unwritable(error) from error
        with lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield partial

    def complete(self, sha256: str) -> Bundle:
        """Verify a finished download and give it its name; a wrong one is removed."""
        partial, path = self._partial(sha256), self._path(sha256)
        try:
            if (found := hash_file(partial)) != sha256:
                partial.unlink()
                raise BundleError(
                    f"the bundle arrived damaged: its hash is {found[:12]}..., not {sha256[:12]}...; try again"
                )
            partial.replace(path)
        except OSError as error:
            raise self.unwritable(error) from error
        return Bundle.open(path, sha256)

    def unwritable(self, error: OSError) -> BundleError:
        """What to say where the folder takes nothing."""
        return BundleError(
            f"cannot write in {self._folder}: {error.strerror}; make room there, or point $DREAMFLEET_CACHE elsewhere"
        )

    def _path(self, sha256: str) -> Path:
        return self._folder / f"{_checked(sha256)}.zip"

    def _partial(self, sha256: str) -> Path:
        return self._folder / f"{_checked(sha256)}.part"


def _checked(sha256: str) -> str:
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


def pretrained() -> Path:
    """The folder of what ships: bundles as `NAME.zip`, controllers as `NAME.npz`."""
    return Path(str(files("dreamfleet.common"))) / "pretrained"


def shipped_bundles() -> dict[str, Path]:
    """The bundles that ship whole, by name."""
    return {path.stem: path for path in sorted(pretrained().glob("*.zip"))}


def _leans() -> Iterator[tuple[Path, Lean]]:
    """The lean files that ship."""
    for path in sorted(pretrained().glob(f"*{SUFFIX}")):
        yield path, read_lean(path, LIMITS)


def shipped_names() -> tuple[str, ...]:
    """The names of all bundles that ship."""
    return (*shipped_bundles(), *(path.stem for path, _ in _leans()))


def find_bundle(name: str) -> Bundle:
    """A shipped bundle by name, or any by path."""
    shipped = shipped_bundles()
    if name in shipped:
        return Bundle.open(shipped[name])
    for path, _ in _leans():
        if path.stem == name:
            return BundleStore(default_cache()).grow(path)
    if not is_there(Path(name)):
        raise BundleError(f"no bundle {name!r}: give a file, or one that ships: {', '.join(shipped_names()) or 'none'}")
    return Bundle.open(Path(name))
