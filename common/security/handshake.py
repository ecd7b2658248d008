"""TLS handshakes: whether a join file agrees with the certificate in it, and why a connection failed.

Only the certificate says who a join file's holder is. Python's `ssl` reads one only as part of a handshake, so both of
its ends are played in memory: this needs neither a network nor the extra `access`. Of a failed connection Zenoh reports
only that it could not connect. Pages: troubleshooting.md.
"""

import socket
import ssl
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from dreamfleet.common.errors import AccessError
from dreamfleet.common.security.credentials import Credentials

NOT_YET_VALID, EXPIRED = 9, 10  # OpenSSL's codes: X509_V_ERR_CERT_NOT_YET_VALID, X509_V_ERR_CERT_HAS_EXPIRED
TIMEOUT = 2.0  # seconds
CLOCK_ALERT = "SSLV3_ALERT_CERTIFICATE_EXPIRED"  # also of a certificate that is not yet valid (RFC 8446, 6.2)


def check_certificate(credentials: Credentials) -> None:
    """`AccessError` if the certificate is not of this seat, end and authority, or not valid by this host's clock.

    Without a certificate, as with a password, there is nothing to compare.
    """
    if not credentials.certificate:
        return
    whose = f"the join file of {credentials.identity} ({credentials.name})"
    try:
        found = _read_certificate(credentials)
    except ssl.SSLCertVerificationError as error:
        damage = " is damaged: its certificate is not of its authority; have another issued"
        why = f": {clock}" if (clock := describe_clock_error(error)) else damage
        raise AccessError(f"{whose}{why}") from error
    except (ssl.SSLError, ValueError, TypeError) as error:
        raise AccessError(f"{whose} is damaged: its certificate or key is invalid; have another issued") from error
    except OSError as error:
        raise AccessError(f"{whose} cannot be checked in a temporary file: {error.strerror}") from error
    name = dict(pair for part in found["subject"] for pair in part).get("commonName")
    end = datetime.fromtimestamp(ssl.cert_time_to_seconds(found["notAfter"]), UTC)
    if (name, end) != (credentials.identity, credentials.expires):
        raise AccessError(
            f"{whose} was edited: its certificate is of {name} until {end:%Y-%m-%d %H:%M} UTC; have another issued"
        )


def describe_clock_error(error: ssl.SSLCertVerificationError) -> str:
    """Why a certificate is not yet valid, or no longer, with this host's clock; empty for other errors."""
    now = f"this host's clock says {datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    if error.verify_code == NOT_YET_VALID:
        return f"its certificate is not yet valid, and {now}: set the clock"
    if error.verify_code == EXPIRED:
        return f"its certificate has expired, and {now}: set the clock if that is wrong, else have it issued again"
    return ""


def load_own_certificate(context: ssl.SSLContext, credentials: Credentials) -> None:
    """Have a TLS context show the certificate of a join file, if it has one; `OSError` or `ValueError`."""
    if not credentials.certificate:
        return
    with TemporaryDirectory(prefix="dreamfleet-") as folder:  # mode 700; `ssl` reads files only
        certificate, key = Path(folder) / "certificate", Path(folder) / "key"
        certificate.write_text(credentials.certificate)
        key.write_text(credentials.key)
        context.load_cert_chain(certificate, key, "")


def _read_certificate(credentials: Credentials) -> dict[str, Any]:
    """The certificate's fields, verified against the authority's and this host's clock; `OSError` or `ValueError`."""
    listening, calling = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    listening.verify_mode = ssl.CERT_REQUIRED
    listening.load_verify_locations(cadata=credentials.ca)
    calling.check_hostname, calling.verify_mode = False, ssl.CERT_NONE
    for context in (listening, calling):
        load_own_certificate(context, credentials)
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    client, server = calling.wrap_bio(back, there), listening.wrap_bio(there, back, server_side=True)
    open_ends = [client, server]
    while open_ends:
        for each in tuple(open_ends):
            try:
                each.do_handshake()
                open_ends.remove(each)
            except ssl.SSLWantReadError:
                continue
    return server.getpeercert() or {}


def diagnose_connection(endpoints: Iterable[str], credentials: Credentials | None) -> str | None:
    """Describe why the first listening endpoint rejects this side; `None` if unknown."""
    for endpoint in endpoints:
        host, _, port = endpoint.partition("/")[2].rpartition(":")
        try:
            link = socket.create_connection((host.strip("[]"), int(port)), TIMEOUT)
        except (OSError, ValueError):  # ValueError: an invalid host name
            continue
        with link:
            if credentials is not None:
                why = _diagnose_tls(link, host, credentials)
                return f"{endpoint} rejects {credentials.identity} ({credentials.name}): {why}"
            if _speaks_tls(link):
                return (
                    f"{endpoint} speaks TLS: its fleet needs a join file; have one issued (`dreamfleet access "
                    "issue`), and give --join FILE, which holds the address, instead of --connect"
                )
    return None


def _speaks_tls(link: socket.socket) -> bool:
    """Whether the other side is a TLS server, of any fleet."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with context.wrap_socket(link):
            return True
    except (OSError, ValueError):
        return False


def _diagnose_tls(link: socket.socket, host: str, credentials: Credentials) -> str:
    try:
        context = ssl.create_default_context(cadata=credentials.ca)
        load_own_certificate(context, credentials)
    except (OSError, ValueError, TypeError):
        return "this join file is damaged: have another issued"
    try:
        with context.wrap_socket(link, server_hostname=host.strip("[]")) as secured:
            return _read_refusal(secured)
    except ssl.SSLCertVerificationError as error:
        return describe_clock_error(error) or (
            f"its certificate is not valid here ({error.verify_message.rstrip('.')}): it is another fleet's, or was "
            "issued without --host for this name; have the coordinator's join file issued again"
        )
    except TimeoutError:  # an unsecured router takes the handshake for an incomplete message
        return "it does not answer TLS: its coordinator was started without --join, or it is too busy"
    except (OSError, ValueError):
        return "it does not speak TLS: its coordinator was started without --join, or another program has the port"


def _read_refusal(secured: ssl.SSLSocket) -> str:
    """Why a listener of this fleet refuses this certificate: in TLS 1.3 it says so only after the handshake."""
    try:
        secured.recv(1)
    except OSError as error:
        if isinstance(error, ssl.SSLError) and error.reason == CLOCK_ALERT:
            return (
                "its clock says that this join file is expired or not yet valid, and this host's clock says "
                f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC: set the clock that is wrong; if none is, have another issued"
            )
    return (
        "it belongs to this fleet but refuses this join file, which may be of another authority or revoked: have "
        "another issued"
    )
