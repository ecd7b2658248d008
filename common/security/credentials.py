"""Who a process is to a secured fleet: what one join file holds, and how it is read.

A join file is TOML, mode 600, written by `dreamfleet access issue`. Its seat is the number behind its role; the router
knows the two as `worker.17`, which is the certificate's common name, or the user where passwords are in force. Reading
one needs no package of the extra `access`.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import stat
import tomllib
from dataclasses import MISSING, dataclass, field, fields
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from dreamfleet.common.errors import AccessError
from dreamfleet.common.files.regular_files import open_regular
from dreamfleet.common.protocol.keys import check_worker_name

VERSION = 1
# The seats of a role that a router keeps: whoever has one is known to it when it starts, also before the file is made.
SEATS = {"coordinator": 50, "router": 50, "operator": 100, "viewer": 100, "worker": 500}
ROLES = tuple(SEATS)
LISTENERS = ("coordinator", "router")
MAX_BYTES = 64 * 1024  # of a join file
EXPIRY_WARNING = timedelta(days=7)  # before the end, when people are warned


@dataclass(frozen=True)
class Credentials:
    """What a join file says: a role's seat until `expires`, where to connect, and what proves it, as PEM texts.

    With certificates `certificate` and `key` prove it. With passwords a listener has these for its own side, and
    `secret`, of which every seat's password follows; all others have nothing but their `password`.
    """

    role: str
    seat: int
    name: str  # as it was issued
    expires: datetime
    ca: str = field(repr=False)
    connect: tuple[str, ...] = ()
    certificate: str = field(default="", repr=False)
    key: str = field(default="", repr=False)
    password: str = field(default="", repr=False)
    secret: str = field(default="", repr=False)

    @property
    def identity(self) -> str:
        """As the router knows it, such as `worker.17`."""
        return identity(self.role, self.seat)

    @property
    def authority(self) -> str:
        """Hash of the authority's certificate."""
        return hash_authority(self.ca)

    @property
    def can_listen(self) -> bool:
        """Whether it can be a fleet's router."""
        return self.role in LISTENERS

    @property
    def uses_passwords(self) -> bool:
        """Whether this fleet is joined by passwords rather than by certificates."""
        return bool(self.password or self.secret)

    def time_left(self, now: datetime) -> timedelta:
        """How long it is still good for."""
        return self.expires - now


def identity(role: str, seat: int) -> str:
    """A seat as the router knows it."""
    return f"{role}.{seat}"


def worker_seat_identity(worker: str) -> str:
    """The identity that a worker `<label>.<seat>/<life>` of a secured fleet has at the router."""
    return f"worker.{worker.partition('/')[0].rpartition('.')[2]}"


def add_seat_to_name(label: str, credentials: Credentials) -> str:
    """A worker's name in a secured fleet, whose router holds it to the seat that this name ends in."""
    end = f".{credentials.seat if credentials.role == 'worker' else credentials.role}"
    return check_worker_name(label[: 63 - len(end)] + end)


def derive_password(secret: str, who: str) -> str:
    """The password of an identity."""
    return hmac.new(bytes.fromhex(secret), who.encode(), hashlib.sha256).hexdigest()


def hash_authority(ca: str) -> str:
    """Hash of an authority's certificate, a PEM text."""
    return hashlib.sha256(ca.encode()).hexdigest()


def describe_time_left(left: timedelta) -> str:
    """For how long something is good, in words."""
    if left <= timedelta():
        return "expired"
    hours = int(left.total_seconds() // 3600)
    return f"{hours // 24} days left" if hours >= 48 else f"{hours} hours left"


def read_join_file(path: Path, now: datetime | None = None) -> Credentials:
    """What a join file holds; `AccessError` if it is none, may be read by others, or has expired at `now`."""
    try:
        with open_regular(path, MAX_BYTES) as file:
            found = os.fstat(file.fileno())
            document = tomllib.loads(file.read(MAX_BYTES).decode())
    except FileNotFoundError:
        raise AccessError(f"no join file at {path}: `dreamfleet access issue` makes one") from None
    except OSError as error:
        raise AccessError(f"{path} cannot be read as a join file: {error.strerror}") from error
    except (ValueError, RecursionError) as error:  # what it says may be a secret
        raise AccessError(f"{path} is no join file: it is no TOML; have another issued") from error
    _check_private(path, found)
    credentials = _parse_credentials(path, document)
    if credentials.time_left(now or datetime.now(UTC)) <= timedelta():
        raise AccessError(
            f"{path} expired on {credentials.expires:%Y-%m-%d}: have {credentials.role} {credentials.name} issued again"
        )
    return credentials


def _check_private(path: Path, found: os.stat_result) -> None:
    """Refuse what others may read, as ssh does: a file of another owner, such as a mounted secret, is that one's."""
    own = found.st_uid == os.geteuid()
    if found.st_mode & (stat.S_IRWXO | (stat.S_IRWXG if own else 0)):
        raise AccessError(f"{path} may be read by others: chmod 600 {path}, or have another issued if they did")


def _parse_credentials(path: Path, document: dict[str, Any]) -> Credentials:
    version = document.pop("version", None)
    if version != VERSION:
        raise AccessError(f"{path} is no join file of this version: have another issued")
    kinds: dict[str, tuple[type, Any]] = {each.name: (str, each.default) for each in fields(Credentials)}
    kinds |= {"seat": (int, MISSING), "expires": (datetime, MISSING), "connect": (list, [])}
    for name, (kind, default) in kinds.items():
        if name not in document and default is MISSING:
            raise AccessError(f"{path} is no join file: {name!r} is missing")
        if type(document.get(name, default)) is not kind:
            raise AccessError(f"{path} is no join file: {name!r} is not of its kind")
    if unknown := sorted(set(document) - set(kinds)):
        raise AccessError(f"{path} is no join file: {unknown[0]!r} is unknown")
    values = {**document, "connect": tuple(document.get("connect", ()))}
    if values["role"] not in SEATS or not 1 <= values["seat"] <= SEATS[values["role"]] or not values["expires"].tzinfo:
        raise AccessError(f"{path} is no join file: its role, seat or end means nothing here")
    if not all(isinstance(each, str) for each in values["connect"]):
        raise AccessError(f"{path} is no join file: 'connect' is not of its kind")
    credentials = Credentials(**values)
    proved = bool(credentials.certificate and credentials.key)
    if not (proved or credentials.password) or (credentials.can_listen and not proved):
        raise AccessError(f"{path} is no join file: what proves its role is missing")
    try:
        bytes.fromhex(credentials.secret)
    except ValueError:
        raise AccessError(f"{path} is no join file: 'secret' is not of its kind") from None
    return credentials


def format_join_file(credentials: Credentials) -> str:
    """A join file's text."""
    lines = [
        f"# dreamfleet: whoever holds this file is {credentials.role} {credentials.name}. Keep it to yourself.",
        f"version = {VERSION}",
        f'role = "{credentials.role}"',
        f"seat = {credentials.seat}",
        f'name = "{credentials.name}"',
        f"expires = {credentials.expires:%Y-%m-%dT%H:%M:%SZ}",
        f"connect = {json.dumps(credentials.connect)}",
    ]
    secret = {name: f'"{getattr(credentials, name)}"' for name in ("password", "secret")}
    pem = {name: f'"""\n{getattr(credentials, name)}"""' for name in ("ca", "certificate", "key")}
    lines.extend(f"{name} = {text}" for name, text in {**secret, **pem}.items() if getattr(credentials, name))
    return "\n".join(lines) + "\n"
