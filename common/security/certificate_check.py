"""Whether a join file agrees with the certificate in it, which alone says who its holder is.

Python's `ssl` reads certificates only as part of a handshake, so both of its ends are played in memory. This needs
neither a network nor the extra `access`.
"""

from __future__ import annotations

import ssl
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from dreamfleet.common.errors import AccessError
from dreamfleet.common.security.credentials import Credentials

NOT_YET_VALID, EXPIRED = 9, 10  # OpenSSL's codes: X509_V_ERR_CERT_NOT_YET_VALID, X509_V_ERR_CERT_HAS_EXPIRED


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
        if error.verify_code in (NOT_YET_VALID, EXPIRED):
            raise AccessError(f"{whose}: {describe_clock_error(error)}") from error
        raise AccessError(
            f"{whose} is damaged: its certificate is not of its authority; have another issued"
        ) from error
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
    """Why a certificate that is not yet valid, or no longer, may be so: this host's clock is named first."""
    now = f"this host's clock says {datetime.now(UTC):%Y-%m-%d %H:%M} UTC"
    if error.verify_code == NOT_YET_VALID:
        return f"its certificate is not yet valid, and {now}: set the clock"
    return f"its certificate has expired, and {now}: set the clock if that is wrong, else have it issued again"


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
