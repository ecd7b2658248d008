"""Server-sent events and responses in JSON: NaN and infinity, which browsers refuse, become null."""

from collections.abc import Mapping
from typing import Any

from msgspec.json import Encoder
from starlette.responses import Response

_ENCODER = Encoder(enc_hook=lambda number: number.item())  # of NumPy


def event(kind: str, document: Mapping[str, Any]) -> bytes:
    """A server-sent event."""
    return b"event: %s\ndata: %s\n\n" % (kind.encode(), _ENCODER.encode(document))


def json_response(document: Mapping[str, Any], status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    """A response that holds the document."""
    return Response(_ENCODER.encode(document), status, headers, "application/json")
