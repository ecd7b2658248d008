"""A fleet's own certificate authority: a folder that issues and revokes join files.

    ca.pem, ca.key   the authority's certificate and private key; keep the key on this host only
    secret           only with passwords: the secret that they are derived from
    issued.json      the list of issued and revoked join files; not secret

Keys are P-256, which every TLS library supports; certificates are X.509 v3 (RFC 5280). Pages: files.md, fleet.md.
"""

from __future__ import annotations

import ipaddress
import json
import os
import re
import secrets
import stat
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from shlex import quote

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, EllipticCurvePrivateKey, generate_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from dreamfleet.common.errors import AccessError, UsageError
from dreamfleet.common.files.atomic_write import atomic_write, check_output_path, reporting_write_errors
from dreamfleet.common.files.locks import open_lock, wait_for_lock
from dreamfleet.common.files.regular_files import others_write, read_regular, read_text
from dreamfleet.common.protocol.keys import check_worker_name
from dreamfleet.common.security.certificate_ledger import LEDGER_FILE, MAX_BYTES, CertificateLedger, IssuedJoinFile
from dreamfleet.common.security.credentials import SEATS, VERSION, Credentials, derive_password, hash_authority

AUTHORITY_DAYS = 3650  # validity of the authority's certificate
# The help of verb.py's --days has these too.
DEFAULT_DAYS = {"coordinator": 90, "router": 90, "operator": 90, "viewer": 90, "worker": 30}  # of join files; verb.py
CLOCK_SKEW = timedelta(minutes=5)  # certificates are valid from so long before their issue
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")  # in the certificate of every listener
_FILES = _CERTIFICATE, _KEY, _SECRET, _LIST = "ca.pem", "ca.key", "secret", LEDGER_FILE
_MAX_FILE_BYTES = 64 * 1024
_HOST = re.compile(r"(\*\.)?[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\.?")


class Authority:
    """A certificate authority in its folder."""

    def __init__(self, folder: Path) -> None:
        """Open an existing authority; `AccessError` if there is none, it is damaged, or others may change it."""
        self._folder = folder
        if _KEY not in _parts(folder):
            raise AccessError(
                f"no authority in {folder}: `dreamfleet access init` creates one, --access-dir names another"
            )
        _check_mine(folder)
        try:
            self._pem = read_text(folder / _CERTIFICATE, _MAX_FILE_BYTES)
            self._certificate = x509.load_pem_x509_certificate(self._pem.encode())
            key = serialization.load_pem_private_key(read_regular(folder / _KEY, _MAX_FILE_BYTES), None)
            self._secret = read_text(folder / _SECRET, _MAX_FILE_BYTES).strip() if (folder / _SECRET).exists() else ""
            bytes.fromhex(self._secret)
        except OSError as error:
            raise AccessError(f"the authority in {folder} cannot be read: {error.strerror}") from error
        except (ValueError, TypeError) as error:
            raise AccessError(f"the authority in {folder} is damaged: restore the folder") from error
        if not isinstance(key, EllipticCurvePrivateKey):
            raise AccessError(f"the authority in {folder} has a key of another type: restore the folder")
        if key.public_key() != self._certificate.public_key():
            raise AccessError(f"the authority in {folder} has the key of another certificate: restore the folder")
        self._key = key

    @classmethod
    def create(cls, folder: Path, *, passwords: bool = False) -> Authority:
        """Create an authority; `UsageError` if the folder holds one, or a part of one."""
        _check_vacant(folder)
        key, now = generate_private_key(SECP256R1()), datetime.now(UTC)
        name = _x509_name(f"dreamfleet {secrets.token_hex(4)}")
        pem = _certify(name, name, key, key, x509.random_serial_number(), now, now + timedelta(days=AUTHORITY_DAYS))
        with reporting_write_errors(folder, "--access-dir"):
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        _check_mine(folder)
        with reporting_write_errors(folder, "--access-dir"), _locked(folder):
            _check_vacant(folder)
            try:
                _write_private(folder / _CERTIFICATE, pem.encode())
                if passwords:
                    _write_private(folder / _SECRET, secrets.token_hex(32).encode())
                save_ledger(CertificateLedger(hash_authority(pem), passwords), folder)
                _write_private(folder / _KEY, _key_bytes(key))  # last: its presence marks a complete authority
            except BaseException:  # so that the next attempt finds the folder vacant
                for each in _FILES:
                    (folder / each).unlink(missing_ok=True)
                raise
        return cls(folder)

    def issue(
        self, role: str, name: str, out: Path, *, connect: Sequence[str] = (), hosts: Sequence[str] = (),
        days: float | None = None, now: datetime | None = None,
    ) -> Credentials:  # fmt: skip
        """Write a new join file to `out`; a name that has a seat already keeps it, unless that was revoked.

        `UsageError` if the file exists.
        """
        check_worker_name(name)
        days, now = DEFAULT_DAYS[role] if days is None else days, now or datetime.now(UTC)
        expires = (now + timedelta(days=days)).replace(microsecond=0)
        check_output_path(out)
        with self._locked_ledger() as ledger:
            if out.exists():
                raise UsageError(f"{out} exists: name another --out")
            seat, shared = _assign_seat(ledger, role, name), {"ca": self._pem, "connect": tuple(connect)}
            who = Credentials(role, seat, name, min(expires, self._certificate.not_valid_after_utc), **shared)  # type: ignore[arg-type]
            serial = x509.random_serial_number()
            if who.can_listen or not ledger.passwords:
                key = generate_private_key(SECP256R1())
                pem = self._sign_certificate(who, key, serial, hosts, now)
                who = replace(who, certificate=pem, key=_key_bytes(key).decode())
            if ledger.passwords and not self._secret:
                raise AccessError(f"{self._folder / _SECRET} is missing, and passwords are derived from it: restore it")
            if ledger.passwords:
                who = (replace(who, secret=self._secret) if who.can_listen
                       else replace(who, password=derive_password(self._secret, who.identity)))  # fmt: skip
            entry = IssuedJoinFile(role, seat, name, f"{serial:x}" if who.certificate else "", who.expires.timestamp())
            # What has expired opens nothing; a revoked seat stays known, and a name's seat by its last file.
            moment = now.timestamp()
            kept = (each for each in ledger.issued
                    if (each.identity, each.revoked) != (who.identity, None) or each.expires > moment)  # fmt: skip
            # Before the file: what is out is known. And all of them can still be revoked, which takes more bytes.
            save_ledger(replace(ledger, issued=(*kept, entry)), self._folder, limit=MAX_BYTES * 4 // 5)
            with reporting_write_errors(out):
                _write_private(out, format_join_file(who).encode())
        return who

    def revoke(self, name: str, role: str | None = None) -> tuple[IssuedJoinFile, ...]:
        """Revoke the join files of a name, and so its seat; returns them.

        `UsageError` if the name has none, or has some of several roles and `role` is not given.
        """
        with self._locked_ledger() as ledger:
            valid = [each for each in ledger.issued if each.revoked is None]
            found = [each for each in valid if each.name == name and role in (None, each.role)]
            if not found:
                raise UsageError(f"nothing is issued to {name!r} that is not revoked: see `dreamfleet access list`")
            if len(roles := sorted({each.role for each in found})) > 1:
                raise UsageError(f"{name!r} is the name of {' and '.join(roles)}: say which with --role")
            save_ledger(with_revoked(ledger, found, time.time()), self._folder)
            return tuple(found)

    def _sign_certificate(
        self, who: Credentials, key: EllipticCurvePrivateKey, serial: int, hosts: Sequence[str], now: datetime
    ) -> str:
        purposes, more = [ExtendedKeyUsageOID.CLIENT_AUTH], list[x509.ExtensionType]()
        if who.can_listen:
            purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
            names = [_alternative_name(each) for each in dict.fromkeys((*hosts, *LOCAL_HOSTS))]
            more.append(x509.SubjectAlternativeName(names))
        more.append(x509.ExtendedKeyUsage(purposes))
        name, authority = _x509_name(who.identity), self._certificate.subject
        return _certify(name, authority, key, self._key, serial, min(now, who.expires), who.expires, more)

    @property
    def uses_passwords(self) -> bool:
        """Whether the files of coordinators and routers hold the secret that gives all passwords."""
        return bool(self._secret)

    @contextmanager
    def _locked_ledger(self) -> Iterator[CertificateLedger]:
        with ExitStack() as stack:
            try:
                stack.enter_context(_locked(self._folder))
            except OSError as error:
                raise AccessError(f"{self._folder} cannot be written: {error.strerror}; nothing is changed") from error
            ledger = CertificateLedger.load(self._folder / LEDGER_FILE)
            if ledger.authority != hash_authority(self._pem):
                raise AccessError(f"{self._folder / LEDGER_FILE} belongs to another authority: restore the folder")
            yield ledger


def save_ledger(ledger: CertificateLedger, folder: Path, limit: int = MAX_BYTES) -> None:
    """Write a ledger's file atomically; `AccessError` if that fails, or takes more than `limit` bytes."""
    path, data = folder / LEDGER_FILE, json.dumps(asdict(ledger), indent=1).encode()
    if len(data) > limit:
        raise AccessError(f"{path} is full: create another authority with `dreamfleet access init`")
    try:
        _write_private(path, data)
    except OSError as error:
        raise AccessError(f"{path} cannot be written: {error.strerror}; nothing is changed") from error


def with_revoked(ledger: CertificateLedger, wanted: Iterable[IssuedJoinFile], now: float) -> CertificateLedger:
    """A copy of a ledger in which some join files are revoked."""
    chosen = set(wanted)
    return replace(ledger, issued=tuple(replace(each, revoked=now) if each in chosen else each
                                        for each in ledger.issued))  # fmt: skip


def format_join_file(credentials: Credentials) -> str:
    """Format credentials as the text of a join file."""
    note = f"this file is the secret of {credentials.role} {credentials.name}. Do not share it."
    lines = [
        f"# dreamfleet: {note}",
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


def _parts(folder: Path) -> list[str]:
    """The files of an authority that a folder holds; `AccessError` if it cannot be read."""
    try:
        return [name for name in _FILES if (folder / name).exists()]
    except OSError as error:
        raise AccessError(f"the authority in {folder} cannot be read: {error.strerror}") from error


def _check_vacant(folder: Path) -> None:
    """`UsageError` if a folder holds an authority, or a part of one: a copy of its list, or all but its key."""
    if found := _parts(folder):
        raise UsageError(f"{folder} holds {', '.join(found)} of an authority already: name another --access-dir")


def _check_mine(folder: Path) -> None:
    """`AccessError` if other users own or may write the folder or a file of the authority, or may read its secrets."""
    for path in (folder, *(folder / each for each in _parts(folder))):
        found = path.stat()
        if found.st_uid not in (os.geteuid(), 0):
            raise AccessError(
                f"{path} is another user's: make an authority in a folder of yours, --access-dir names it"
            )
        is_open = path.name in (_KEY, _SECRET) and bool(found.st_mode & (stat.S_IRWXG | stat.S_IRWXO))
        if is_open or others_write(found):
            raise AccessError(
                f"others may change or read {path}: chmod go= {quote(str(path))}; if they did, make another authority"
            )


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock; waits for another command, which takes a moment."""
    with open_lock(folder / "lock") as file:
        wait_for_lock(file)
        yield


def _assign_seat(ledger: CertificateLedger, role: str, name: str) -> int:
    """The seat of a name, else the next free one; revoked seats are never reused."""
    own = [each for each in ledger.issued if each.role == role]
    for each in own:
        if each.name == name and each.revoked is None:
            return each.seat
    seat = max((each.seat for each in own), default=0) + 1
    if seat > SEATS[role]:
        raise AccessError(
            f"all {SEATS[role]} seats of role {role} are taken: create another authority with `dreamfleet access init`"
        )
    return seat


def _certify(
    subject: x509.Name, issuer: x509.Name, key: EllipticCurvePrivateKey, signer: EllipticCurvePrivateKey, serial: int,
    start: datetime, end: datetime, more: Iterable[x509.ExtensionType] = (),
) -> str:  # fmt: skip
    """A certificate of `key` as PEM, signed by `signer`: an authority's if it is the same; `more` are not critical."""
    is_authority = key is signer
    usage = x509.KeyUsage(
        digital_signature=True, content_commitment=False, key_encipherment=False, data_encipherment=False,
        key_agreement=False, key_cert_sign=is_authority, crl_sign=is_authority, encipher_only=False,
        decipher_only=False,
    )  # fmt: skip
    builder = x509.CertificateBuilder(
        issuer_name=issuer, subject_name=subject, public_key=key.public_key(), serial_number=serial,
        not_valid_before=start - CLOCK_SKEW, not_valid_after=end,
    )  # fmt: skip
    limits = x509.BasicConstraints(ca=is_authority, path_length=0 if is_authority else None)
    for each in (limits, usage, *more):
        builder = builder.add_extension(each, critical=each in (limits, usage))
    return builder.sign(signer, hashes.SHA256()).public_bytes(serialization.Encoding.PEM).decode()


def _x509_name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _alternative_name(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(text.strip("[]")))
    except ValueError:
        pass
    if not _HOST.fullmatch(text):  # internationalised names in their `xn--` form
        raise UsageError(f"--host {text!r} is not a host: give a name or an address, without a port")
    return x509.DNSName(text)


def _key_bytes(key: EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write_private(path: Path, data: bytes) -> None:
    with atomic_write(path, private=True) as file:
        file.write(data)
