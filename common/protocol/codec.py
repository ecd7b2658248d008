"""Strict encoding and decoding of messages: msgpack, or JSON for documents that people and tools read.

A payload never becomes an object if it is oversize, not msgpack, of another version, lacks or adds a field, or has a
value of a wrong type, out of range, or NaN. `CountingDecoder` counts such payloads by reason instead of raising.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import fields
from typing import Any, TypeVar

import msgpack

from dreamfleet.common.protocol.keys import PROTOCOL_VERSION
from dreamfleet.common.protocol.messages import MAX_MESSAGE, Message
from dreamfleet.common.serialization.validation import MalformedError, T, checker_of, to_checked_plain, to_plain

M = TypeVar("M", bound=Message)


def encoding(kind: type[Any]) -> str:
    """The Zenoh encoding string of a message type."""
    return f"application/msgpack;dreamfleet.{kind.SCHEMA}.v{PROTOCOL_VERSION}"


def encode(message: Message) -> bytes:
    """Encode a message as msgpack; `MalformedError` if it breaks its own schema, as a peer would drop it."""
    payload: bytes = msgpack.packb({"v": PROTOCOL_VERSION, **to_checked_plain(message)})
    if len(payload) > MAX_MESSAGE:
        raise MalformedError("oversize")
    return payload


def decode(kind: type[M], payload: bytes) -> M:
    """Decode a message; `MalformedError` if the payload does not fit the schema."""
    if len(payload) > MAX_MESSAGE:
        raise MalformedError("oversize")
    try:
        raw = msgpack.unpackb(payload, raw=False, strict_map_key=True, use_list=True)
    except Exception as error:  # msgpack raises a dozen types of error, some built-in
        raise MalformedError("not msgpack") from error
    if not isinstance(raw, dict):
        raise MalformedError("not a message")
    if raw.pop("v", None) != PROTOCOL_VERSION:
        raise MalformedError("unknown version")
    message: M = checker_of(kind)(raw)
    return message


def encode_json(document: Any) -> bytes:
    """Encode a dataclass as JSON, checked like `encode`."""
    plain = to_plain(document)
    checker_of(type(document))(plain)
    return json.dumps(plain, allow_nan=False).encode()


def decode_json(kind: type[T], payload: bytes) -> T:
    """Decode a JSON document; unknown fields are ignored, so that later versions can add some to `hello`."""
    if len(payload) > MAX_MESSAGE:
        raise MalformedError("oversize")
    try:
        raw = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise MalformedError("not JSON") from error
    if not isinstance(raw, dict):
        raise MalformedError("not a message")
    known = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    document: T = checker_of(kind)({name: value for name, value in raw.items() if name in known})
    return document


class CountingDecoder:
    """Decodes received payloads; counts malformed ones by reason in `dropped`."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()

    def decode(self, kind: type[M], payload: bytes) -> M | None:
        """Decode a message; `None` if it is malformed."""
        try:
            return decode(kind, payload)
        except MalformedError as error:
            self.dropped[error.args[0]] += 1
            return None

    def decode_json(self, kind: type[T], payload: bytes) -> T | None:
        """Decode a JSON document; `None` if it is malformed."""
        try:
            return decode_json(kind, payload)
        except MalformedError as error:
            self.dropped[error.args[0]] += 1
            return None
