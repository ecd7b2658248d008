"""What an authority issued, and what it took back: a list without secrets, which a coordinator reads as it serves."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from dreamfleet.common.codec import MalformedError, from_plain
from dreamfleet.common.credentials import Credentials, identity
from dreamfleet.common.errors import AccessError
from dreamfleet.common.files import read_regular, write_aside

log = logging.getLogger(__name__)
ISSUED = "issued.json"  # in the authority's folder
MOST_BYTES = 4_000_000
PACE = 2.0  # seconds between looks at whether it changed


@dataclass(frozen=True)
class Issued:
    """A join file that was made; times in seconds since 1970."""

    role: str
    seat: int
    name: str
    serial: str  # of the certificate, in hex; empty where there is none
    expires: float
    revoked: float | None = None

    @property
    def identity(self) -> str:
        """As the router knows it."""
        return identity(self.role, self.seat)

    @property
    def when(self) -> datetime:
        """When it expires."""
        return datetime.fromtimestamp(self.expires, UTC)


@dataclass(frozen=True)
class Ledger:
    """All that one authority issued, the oldest first."""

    authority: str  # hash of its certificate
    passwords: bool = False
    issued: tuple[Issued, ...] = ()

    @classmethod
    def load(cls, path: Path) -> Ledger:
        """From its file; `AccessError` if that is damaged."""
        try:
            document = json.loads(read_regular(path, MOST_BYTES))
            return from_plain(cls, document)
        except OSError as error:
            raise AccessError(f"{path} cannot be read: {error.strerror}") from error
        except (ValueError, RecursionError, MalformedError) as error:
            raise AccessError(f"{path} is damaged: {error}; restore it") from error

    def save(self, path: Path) -> None:
        """Write it whole; `AccessError` if that fails, and it is as before."""
        try:
            with write_aside(path, private=True) as file:
                file.write(json.dumps(asdict(self), indent=1).encode())
        except OSError as error:
            raise AccessError(f"{path} cannot be written: {error.strerror}; nothing is changed") from error

    def barred(self) -> frozenset[str]:
        """The seats that were taken back."""
        return frozenset(each.identity for each in self.issued if each.revoked is not None)

    def with_revoked(self, wanted: Iterable[Issued], now: float) -> Ledger:
        """The same where some were taken back."""
        chosen = set(wanted)
        return replace(self, issued=tuple(replace(each, revoked=now) if each in chosen else each
                                          for each in self.issued))  # fmt: skip


class Revocations:
    """Which seats are barred, by a ledger that may change while this lives; without credentials nothing is."""

    def __init__(self, folder: Path, credentials: Credentials | None) -> None:
        """`AccessError` where the folder's ledger is damaged or another authority's: what it revoked would stand."""
        self._path = folder / ISSUED
        self._authority = credentials.authority if credentials else None
        self._next = float("-inf")
        self._seen: tuple[int, int, int] | None = None
        self.barred: frozenset[str] = frozenset()
        if credentials is None:
            return
        try:
            there = self._path.exists()
        except OSError as error:  # what it revoked would stand
            raise AccessError(f"{self._path} cannot be read: {error.strerror}") from error
        if not there:
            log.warning("there is no %s: nothing is revoked (--access-dir)", self._path)
        else:
            self._take(time.monotonic())

    def look(self, now: float) -> None:
        """Read it again if it changed; what cannot be read leaves what is known."""
        if self._authority is None or now < self._next:
            return
        try:
            self._take(now)
        except AccessError as error:
            log.warning("%s; what was revoked until now stays so", error)

    def _take(self, now: float) -> None:
        self._next = now + PACE
        try:
            found = self._path.stat()
        except OSError:  # gone
            return
        seen = found.st_ino, found.st_mtime_ns, found.st_size
        if seen == self._seen:
            return
        self._seen = seen
        ledger = Ledger.load(self._path)
        if ledger.authority != self._authority:
            raise AccessError(f"{self._path} is of another authority than the join file: name its own --access-dir")
        for each in sorted(ledger.barred() - self.barred):
            log.warning("%s is revoked: nothing that it says counts", each)
        self.barred = ledger.barred()
