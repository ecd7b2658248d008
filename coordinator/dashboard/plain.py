"""Documents as JSON that every browser reads: a number that JSON does not have becomes null."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any


def written(document: Mapping[str, Any]) -> str:
    """The document, on one line."""
    try:
        return _dumped(document)
    except ValueError:
        return _dumped(_tamed(document))


def event(kind: str, document: Mapping[str, Any]) -> bytes:
    """A server-sent event."""
    return f"event: {kind}\ndata: {written(document)}\n\n".encode()


def _dumped(document: Any) -> str:
    return json.dumps(document, allow_nan=False, separators=(",", ":"))


def _tamed(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _tamed(inner) for name, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_tamed(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
