"""Strict encoding of the messages: msgpack on the wire, JSON where people and tools read.

A message that is oversize, not msgpack, of another version, lacking or adding a field, of a wrong type, out of range,
or carrying NaN never becomes an object. `CountingDecoder` counts such messages by reason; nothing is raised past it.
"""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import fields
from typing import Any, TypeVar

import msgpack

from dreamfleet.common.protocol.keys import PROTOCOL_VERSION
from dreamfleet.common.protocol.messages import MAX_MESSAGE, Message
from dreamfleet.common.serialization.validation import MalformedError, T, checker_of, to_plain

M = TypeVar("M", bound=Message)


def encoding(kind: type[Any]) -> str:
    """The Zenoh encoding that names a message's schema."""
    return f"application/msgpack;dreamfleet.{kind.SCHEMA}.v{PROTOCOL_VERSION}"


def encode(message: Message) -> bytes:
    """Msgpack of a message; our own messages are checked too, so that no peer has to drop them."""
    plain = to_plain(message)
    checker_of(type(message))(plain)
    payload: bytes = msgpack.packb({"v": PROTOCOL_VERSION, **plain})
    if len(payload) > MAX_MESSAGE:
        raise MalformedError("oversize")
    return payload


def decode(kind: type[M], payload: bytes) -> M:
    """The message in `payload`, or `MalformedError`."""
    if len(payload) > MAX_MESSAGE:
        raise MalformedError("oversize")
    try:
        raw = msgpack.unpackb(payload, raw=False, strict_map_key=True, use_list=True)
    except Exception as error:  # msgpack raises a dozen kinds of error, some of them not its own
        raise MalformedError("not msgpack") from error
    if not isinstance(raw, dict):
        raise MalformedError("not a message")
    if raw.pop("v", None) != PROTOCOL_VERSION:
        raise MalformedError("unknown version")
    message: M = checker_of(kind)(raw)
    return message


def encode_json(document: Any) -> bytes:
    """JSON of a dataclass, checked as `encode` does."""
    plain = to_plain(document)
    checker_of(type(document))(plain)
    return json.dumps(plain, allow_nan=False).encode()


def decode_json(kind: type[T], payload: bytes) -> T:
    """The document in `payload`; fields that this version does not know are ignored, for hello must never change."""
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
    """Decodes what arrives; counts what is not of the schema, by reason."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()

    def decode(self, kind: type[M], payload: bytes) -> M | None:
        """The message, or `None` after counting why not."""
        try:
            return decode(kind, payload)
        except MalformedError as error:
            self.dropped[error.args[0]] += 1
            return None

    def decode_json(self, kind: type[T], payload: bytes) -> T | None:
        """The document, or `None` after counting why not."""
        try:
            return decode_json(kind, payload)
        except MalformedError as error:
            self.dropped[error.args[0]] += 1
            return None
