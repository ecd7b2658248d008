"""Strict encoding and decoding of messages: msgpack, or JSON for documents that people and tools read.

A payload never becomes an object if it is oversize, not msgpack, of another version, lacks or adds a field, or has a
value of a wrong type, out of range, or NaN. `CountingDecoder` counts such payloads by reason instead of raising.
"""

import json
import logging
from collections import Counter
from collections.abc import Callable
from typing import Any, TypeVar

import msgpack
import msgspec

from dreamfleet.common.protocol.keys import PROTOCOL_VERSION
from dreamfleet.common.protocol.messages import MAX_MESSAGE, Message
from dreamfleet.common.schema.validation import (
    SCHEMA,
    MalformedError,
    T,
    convert,
    from_plain,
    from_plain_lenient,
    to_plain,
)

log = logging.getLogger(__name__)
M = TypeVar("M", bound=Message)

OVERSIZE, NO_MESSAGE, UNKNOWN_VERSION = "oversize", "not a message", "unknown version"  # reasons, which are counted
NOT_MSGPACK, NOT_JSON = "not msgpack", "not JSON"


def encoding(kind: type[Any]) -> str:
    """The Zenoh encoding string of a message type."""
    return f"application/msgpack;dreamfleet.{kind.SCHEMA}.v{PROTOCOL_VERSION}"


def encode(message: Message) -> bytes:
    """Encode a message as msgpack; `MalformedError` if it breaks its own schema, as a peer would drop it."""
    try:
        checked = convert(type(message), _to_builtins(message))  # its words are the schema's own: see `_to_builtins`
        payload: bytes = msgpack.packb({"v": PROTOCOL_VERSION, **_to_builtins(checked)})
    except (TypeError, UnicodeEncodeError) as error:  # a value that is no plain data, or half a surrogate pair
        raise MalformedError(str(error), SCHEMA) from error
    if len(payload) > MAX_MESSAGE:
        raise MalformedError(OVERSIZE)
    return payload


def _to_builtins(message: Message) -> dict[str, Any]:
    """The fields of a message; one that *is* its default is left out, and an equal one of another object is not."""
    plain: dict[str, Any] = msgspec.to_builtins(message, builtin_types=(bytes,))
    return plain


def decode(kind: type[M], payload: bytes) -> M:
    """Decode a message; `MalformedError` if the payload does not fit the schema."""
    if len(payload) > MAX_MESSAGE:
        raise MalformedError(OVERSIZE)
    try:
        raw = msgpack.unpackb(payload, raw=False, strict_map_key=True, use_list=True)
    except Exception as error:  # msgpack raises a dozen types of error, some built-in
        raise MalformedError(NOT_MSGPACK) from error
    if not isinstance(raw, dict):
        raise MalformedError(NO_MESSAGE)
    if raw.pop("v", None) != PROTOCOL_VERSION:
        raise MalformedError(UNKNOWN_VERSION)
    return convert(kind, raw)


def encode_json(document: Any) -> bytes:
    """Encode a dataclass as JSON, checked like `encode`."""
    plain = to_plain(document)
    from_plain(type(document), plain)
    return json.dumps(plain, allow_nan=False).encode()


def decode_json(kind: type[T], payload: bytes) -> T:
    """Decode a JSON document; unknown fields are ignored, so that later versions can add some to `hello`."""
    if len(payload) > MAX_MESSAGE:
        raise MalformedError(OVERSIZE)
    try:
        raw = json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise MalformedError(NOT_JSON) from error
    if not isinstance(raw, dict):
        raise MalformedError(NO_MESSAGE)
    return from_plain_lenient(kind, raw)


class CountingDecoder:
    """Decodes received payloads; counts malformed ones by reason in `dropped`."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()

    def decode(self, kind: type[M], payload: bytes) -> M | None:
        """Decode a message; `None` if it is malformed."""
        return self._count(decode, kind, payload)

    def decode_json(self, kind: type[T], payload: bytes) -> T | None:
        """Decode a JSON document; `None` if it is malformed."""
        return self._count(decode_json, kind, payload)

    def _count(self, read: Callable[[type[T], bytes], T], kind: type[T], payload: bytes) -> T | None:
        try:
            return read(kind, payload)
        except MalformedError as error:
            if error.reason not in self.dropped:  # the first one: a flood of them must not fill the log
                log.info("dropped a message as malformed: %s", error)
            self.dropped[error.reason] += 1
            return None
