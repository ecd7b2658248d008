"""Server-sent events and responses in JSON: NaN and infinity, which browsers refuse, become null."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from starlette.responses import Response


def to_json(document: Mapping[str, Any]) -> str:
    """The document as JSON, on one line."""
    try:
        return _dumps(document)
    except ValueError:
        return _dumps(_without_non_finite(document))


def event(kind: str, document: Mapping[str, Any]) -> bytes:
    """A server-sent event."""
    return f"event: {kind}\ndata: {to_json(document)}\n\n".encode()


def json_response(document: Mapping[str, Any], status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    """A response that holds the document."""
    return Response(to_json(document), status, headers, "application/json")


def _dumps(document: Any) -> str:
    return json.dumps(document, allow_nan=False, separators=(",", ":"))


def _without_non_finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _without_non_finite(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_non_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
