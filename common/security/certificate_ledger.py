"""The list of an authority's issued and revoked join files. It holds no secrets; running coordinators reload it."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from dreamfleet.common.errors import AccessError
from dreamfleet.common.files.regular_files import read_regular
from dreamfleet.common.schema.validation import MalformedError, Moment, from_plain
from dreamfleet.common.security.credentials import Credentials, identity, issue_command

log = logging.getLogger(__name__)
LEDGER_FILE = "issued.json"  # in the authority's folder (docs/reference/files.md)
MAX_BYTES = 4_000_000
CHECK_INTERVAL = 2.0  # seconds between checks for changes


@dataclass(frozen=True)
class IssuedJoinFile:
    """An issued join file; times in seconds since 1970."""

    role: str
    seat: int
    name: str
    serial: str  # of the certificate, hexadecimal; empty without one
    expires: Moment
    revoked: Moment | None = None

    @property
    def identity(self) -> str:
        """Its seat's identity at the router."""
        return identity(self.role, self.seat)

    @property
    def expires_at(self) -> datetime:
        """When it expires."""
        return datetime.fromtimestamp(self.expires, UTC)


@dataclass(frozen=True)
class CertificateLedger:
    """The join files that one authority issued, oldest first; of those that expired, revoked ones and names' last."""

    authority: str  # hash of its certificate
    passwords: bool = False
    issued: tuple[IssuedJoinFile, ...] = ()

    @classmethod
    def load(cls, path: Path) -> CertificateLedger:
        """Read the ledger's file; `AccessError` if it is damaged."""
        try:
            document = json.loads(read_regular(path, MAX_BYTES))
            return from_plain(cls, document)
        except OSError as error:
            raise AccessError(f"{path} cannot be read: {error.strerror}") from error
        except (ValueError, RecursionError, MalformedError) as error:
            raise AccessError(f"{path} is damaged: {error}; restore it") from error

    def revoked_seats(self) -> frozenset[str]:
        """The identities of revoked seats."""
        return frozenset(each.identity for each in self.issued if each.revoked is not None)


class RevocationWatcher:
    """The revoked seats by a ledger file, reloaded when it changes; none without credentials.

    A revocation is final: a seat stays revoked if the file is removed, damaged, or replaced by an older copy.
    """

    def __init__(
        self, folder: Path, credentials: Credentials | None, kept: Collection[str] = (), *, named: bool = False
    ) -> None:
        """`kept` are seats that are known to be revoked; `named` says that the user chose the folder.

        `AccessError` if the own seat is revoked, if the folder's ledger is damaged or another authority's, or if there
        is none although the folder was named or seats are known to be revoked: others may be revoked too.
        """
        self._path = folder / LEDGER_FILE
        self._credentials = credentials
        self._next = float("-inf")
        self._seen: tuple[int, ...] | None = None  # of the ledger that was last loaded
        self._complaint = ""  # why the last attempt failed, logged once
        self.revoked_seats = frozenset(kept)
        if credentials is None:
            return
        if exists_in(folder):
            self._reload(time.monotonic())
        elif kept:
            raise AccessError(
                f"there is no {self._path}, and this run's fleet has revoked {len(kept)} of its files: name its "
                "folder with --access-dir, or copy issued.json of the authority into one (it holds no secret)"
            )
        elif named:
            raise AccessError(f"there is no {self._path}: name the authority's folder, or one with a copy of that file")
        else:
            log.warning("there is no %s: nothing is revoked (--access-dir)", self._path)
        self.check_own_file()

    @property
    def authority(self) -> str:
        """Hash of the authority's certificate; empty without credentials."""
        return "" if self._credentials is None else self._credentials.authority

    def check_own_file(self) -> None:
        """`AccessError` if the join file of this program is revoked or has expired: nobody should follow it then."""
        own = self._credentials
        if own is None:
            return
        is_revoked = own.identity in self.revoked_seats
        if is_revoked or own.time_left <= timedelta():
            raise AccessError(
                f"the join file of {own.identity} ({own.name}) {'is revoked' if is_revoked else 'has expired'}: have "
                f"another issued with `{issue_command(own.role, own.name, own.connect)}`"
            )

    def reload_if_changed(self, now: float) -> None:
        """Reload the ledger if it changed; a damaged or missing one only logs a warning."""
        if self._credentials is None or now < self._next:
            return
        complaint = ""
        try:
            self._reload(now)
        except AccessError as error:
            complaint = str(error)
            if complaint != self._complaint:
                log.warning("%s; earlier revocations stay in force", error)
        self._complaint = complaint

    def _reload(self, now: float) -> None:
        self._next = now + CHECK_INTERVAL
        try:
            found = self._path.stat()
        except OSError as error:
            if self._seen is None:  # there was none
                return
            raise AccessError(f"{self._path} is gone: what is revoked from now on is not seen; put it back") from error
        seen = found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size
        if seen == self._seen:
            return
        ledger = CertificateLedger.load(self._path)
        if ledger.authority != self.authority:
            raise AccessError(f"{self._path} belongs to another authority than the join file: name its --access-dir")
        for each in sorted(ledger.revoked_seats() - self.revoked_seats):
            log.warning(
                "%s is revoked: a worker's messages are ignored; a router refuses it from its next start on", each
            )
        self.revoked_seats |= ledger.revoked_seats()
        self._seen = seen  # only now: a ledger that could not be read is tried again


def exists_in(folder: Path) -> bool:
    """Whether a folder holds a ledger; `AccessError` if it cannot be read."""
    try:
        return (folder / LEDGER_FILE).exists()
    except OSError as error:
        raise AccessError(f"{folder / LEDGER_FILE} cannot be read: {error.strerror}") from error
