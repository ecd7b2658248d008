"""Credentials of a secured fleet: the contents of join files, and reading them.

A join file is TOML, mode 600, written by `dreamfleet access issue`. Role and seat form its identity at the router, such
as `worker.17`: the certificate's common name, or the user name with passwords. Reading one does not need the extra
`access`. Pages: files.md.
"""

import hashlib
import hmac
import os
import stat
import tomllib
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from shlex import join, quote
from typing import Annotated, Any

from msgspec import Meta

from dreamfleet.common.errors import AccessError
from dreamfleet.common.files.regular_files import open_regular
from dreamfleet.common.protocol.keys import check_worker_name, host_of
from dreamfleet.common.schema.validation import OPTIONAL, MalformedError, from_plain

VERSION = 1
# Number of seats of each role. A router knows all seats when it starts, also those issued later.
SEATS = {"coordinator": 50, "router": 50, "operator": 100, "viewer": 100, "worker": 500}
ROLES = tuple(SEATS)
LISTENERS = ("coordinator", "router")
MAX_BYTES = 64 * 1024  # of a join file
EXPIRY_WARNING = timedelta(days=7)  # before the end, from when on warnings are logged


@dataclass(frozen=True)
class Credentials:
    """The contents of a join file: a seat of a role until `expires`, addresses, and secrets (PEM texts).

    In a fleet with certificates all roles have `certificate` and `key`. With passwords listeners have these and
    `secret`, from which every seat's password is derived; other roles have only their `password`.
    """

    role: str
    seat: int
    name: str  # as issued
    expires: Annotated[datetime, Meta(tz=True)]
    ca: str = field(repr=False)
    connect: tuple[str, ...] = field(default=(), metadata=OPTIONAL)
    certificate: str = field(default="", repr=False, metadata=OPTIONAL)
    key: str = field(default="", repr=False, metadata=OPTIONAL)
    password: str = field(default="", repr=False, metadata=OPTIONAL)
    secret: Annotated[str, Meta(pattern="^([0-9a-f]{2})*$")] = field(default="", repr=False, metadata=OPTIONAL)

    @property
    def identity(self) -> str:
        """The identity at the router, such as `worker.17`."""
        return identity(self.role, self.seat)

    @property
    def authority(self) -> str:
        """Hash of the authority's certificate."""
        return hash_authority(self.ca)

    @property
    def can_listen(self) -> bool:
        """Whether its role may listen as the fleet's router."""
        return self.role in LISTENERS

    @property
    def uses_passwords(self) -> bool:
        """Whether the fleet uses passwords rather than certificates."""
        return bool(self.password or self.secret)

    @property
    def time_left(self) -> timedelta:
        """The time until it expires, by this host's clock."""
        return self.expires - datetime.now(UTC)

    def check_time(self, what: str) -> None:
        """`AccessError` if it has expired; `what` names it, such as its file."""
        if self.time_left <= timedelta():
            raise AccessError(
                f"{what} expired on {self.expires:%Y-%m-%d}, and this host's clock says "
                f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC: set the clock if that is wrong, else have "
                f"{self.role} {self.name} issued again"
            )


def issue_command(role: str, name: str, connect: tuple[str, ...] = ()) -> str:
    """The command by which a join file of this role is issued, in full; a listener is reached by names."""
    there = connect or (() if role in LISTENERS else ("tls/HOST:7447",))
    reached = [*(("--host", "HOST") if role in LISTENERS else ()), *(("--connect", *there) if there else ())]
    return join(("dreamfleet", "access", "issue", role, name, *reached, "--out", "FILE"))


def identity(role: str, seat: int) -> str:
    """The identity of a seat at the router."""
    return f"{role}.{seat}"


def worker_seat_identity(worker: str) -> str:
    """The identity at the router of a secured fleet's worker, by the end of its name before `/`.

    >>> worker_seat_identity("gpu.1/0badc0de"), worker_seat_identity("gpu.coordinator-2/0badc0de")
    ('worker.1', 'coordinator.2')
    """
    seat = host_of(worker).rpartition(".")[2]
    return seat.replace("-", ".") if "-" in seat else f"worker.{seat}"  # a worker's name must end in a number


def add_seat_to_name(label: str, credentials: Credentials) -> str:
    """A worker's name in a secured fleet: it ends in its seat, and of another role in that role and seat."""
    end = f".{credentials.seat if credentials.role == 'worker' else f'{credentials.role}-{credentials.seat}'}"
    return check_worker_name(label[: 63 - len(end)] + end)


def derive_password(secret: str, who: str) -> str:
    """The password of an identity: HMAC-SHA-256 under the fleet's secret."""
    return hmac.new(bytes.fromhex(secret), who.encode(), hashlib.sha256).hexdigest()


def hash_authority(ca: str) -> str:
    """Hash of an authority's certificate, a PEM text."""
    return hashlib.sha256(ca.encode()).hexdigest()


def describe_time_left(left: timedelta) -> str:
    """Format the time until something expires."""
    if left <= timedelta():
        return "expired"
    hours = int(left.total_seconds() // 3600)
    return f"{hours // 24} days left" if hours >= 48 else f"{hours} hours left"


def read_join_file(path: Path) -> Credentials:
    """Read a join file; `AccessError` if it is invalid, readable by others, or expired."""
    try:
        with open_regular(path, MAX_BYTES) as file:
            found = os.fstat(file.fileno())
            document = tomllib.loads(file.read(MAX_BYTES).decode())
    except FileNotFoundError:
        raise AccessError(f"no join file at {path}: `dreamfleet access issue` creates one") from None
    except OSError as error:
        raise AccessError(f"{path} cannot be read as a join file: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # not quoted: it may contain secrets
        raise AccessError(f"{path} is not a join file: it is not TOML; have another issued") from error
    _check_private(path, found)
    credentials = _parse_credentials(path, document)
    credentials.check_time(str(path))
    return credentials


def _check_private(path: Path, found: os.stat_result) -> None:
    """`AccessError` if others can read the file, as in ssh; the group may if the owner differs (mounted secrets)."""
    own = found.st_uid == os.geteuid()
    if found.st_mode & (stat.S_IRWXO | (stat.S_IRWXG if own else 0)):
        raise AccessError(f"{path} may be read by others: chmod 600 {quote(str(path))}; if it was, have another issued")


def _parse_credentials(path: Path, document: dict[str, Any]) -> Credentials:
    if document.pop("version", None) != VERSION:
        raise AccessError(f"{path} is not a join file of this version: have another issued")
    try:
        credentials = from_plain(Credentials, document)
    except MalformedError as error:
        raise AccessError(f"{path} is not a join file: {error}") from error
    if not 1 <= credentials.seat <= SEATS.get(credentials.role, 0):
        raise AccessError(f"{path} is not a join file: its role or seat is invalid")
    has_certificate = bool(credentials.certificate and credentials.key)
    if not (has_certificate or credentials.password) or (credentials.can_listen and not has_certificate):
        raise AccessError(f"{path} is not a join file: its certificate, key or password is missing")
    return credentials
