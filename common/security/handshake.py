"""Diagnosis of failed connections: Zenoh reports only that it could not connect."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Iterable
from datetime import UTC, datetime

from dreamfleet.common.security.certificate_check import (
    EXPIRED,
    NOT_YET_VALID,
    describe_clock_error,
    load_own_certificate,
)
from dreamfleet.common.security.credentials import Credentials

PATIENCE = 2.0  # seconds
CLOCK_ALERT = "SSLV3_ALERT_CERTIFICATE_EXPIRED"  # also of a certificate that is not yet valid (RFC 8446, 6.2)


def diagnose_connection(endpoints: Iterable[str], credentials: Credentials | None) -> str | None:
    """Describe why the first listening endpoint rejects this side; `None` if unknown."""
    for endpoint in endpoints:
        host, _, port = endpoint.partition("/")[2].rpartition(":")
        try:
            link = socket.create_connection((host.strip("[]"), int(port)), PATIENCE)
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
        if error.verify_code in (NOT_YET_VALID, EXPIRED):
            return describe_clock_error(error)
        return (
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
