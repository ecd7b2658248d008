"""Strict encoding of the messages: msgpack on the wire, JSON where people and tools read.

A message that is oversize, not msgpack, of another version, lacking or adding a field, of a wrong type, out of range,
or carrying NaN never becomes an object. `Inbox` counts such messages by reason; nothing is raised past it.
"""

from __future__ import annotations

import json
import math
import types
from collections import Counter
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgpack

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.fields import optionals
from dreamfleet.common.keys import PROTOCOL_VERSION
from dreamfleet.common.messages import MAX_MESSAGE, Between, Length, Message

Check = Callable[[Any], Any]
M = TypeVar("M", bound=Message)
T = TypeVar("T")
MAX_ITEMS = 4096  # of a list without a bound of its own


class MalformedError(DreamfleetError, ValueError):
    """A message that is not of the schema; `args[0]` is the reason to count it under, or for people to read."""


def encoding(kind: type[Any]) -> str:
    """The Zenoh encoding that names a message's schema."""
    return f"application/msgpack;dreamfleet.{kind.SCHEMA}.v{PROTOCOL_VERSION}"


def encode(message: Message) -> bytes:
    """Msgpack of a message; our own messages are checked too, so that no peer has to drop them."""
    plain = _plain(message)
    _checker(type(message))(plain)
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
    message: M = _checker(kind)(raw)
    return message


def encode_json(document: Any) -> bytes:
    """JSON of a dataclass, checked as `encode` does."""
    plain = _plain(document)
    _checker(type(document))(plain)
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
    document: T = _checker(kind)({name: value for name, value in raw.items() if name in known})
    return document


def from_plain(kind: type[T], plain: Any) -> T:
    """A dataclass from its plain form, checked; `MalformedError` if it does not fit."""
    checked: T = _checker(kind)(plain)
    return checked


class Inbox:
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


def _plain(value: Any) -> Any:
    """Nested dataclasses as dictionaries, without `dataclasses.asdict`'s deep copies of every vector."""
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    kind: Any = type(value)
    names = _field_names(kind)
    if not names:
        return value
    plain = {name: _plain(getattr(value, name)) for name in names}
    for name, default in optionals(kind).items():
        if getattr(value, name) == default:
            del plain[name]
    return plain


@cache
def _field_names(kind: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else ()


def _checker(hint: Any) -> Check:
    """A type annotation as a function that returns the checked value or raises."""
    return _compile(hint)


@cache
def _compile(hint: Any) -> Check:
    if is_dataclass(hint) and isinstance(hint, type):
        return _dataclass_checker(hint)
    origin = get_origin(hint)
    if origin is Annotated:
        base, *bounds = get_args(hint)
        return _bounded(_checker_for_items(base, bounds), bounds)
    if origin is tuple:
        return _checker_for_items(hint, [])
    if origin is Literal:
        return _literal_checker(get_args(hint))
    if origin in (Union, types.UnionType):
        return _optional_checker(get_args(hint))
    if hint is float:
        return _finite
    if origin is dict:
        return _object if get_args(hint)[1] is Any else _mapping_checker(get_args(hint)[1])
    return _exactly(hint)


def _checker_for_items(hint: Any, bounds: list[Any]) -> Check:
    """A tuple's checker; its length is bounded before any item is looked at."""
    if get_origin(hint) is not tuple:
        return _checker(hint)
    check = _checker(get_args(hint)[0])
    most = min([bound.high for bound in bounds if isinstance(bound, Length)], default=MAX_ITEMS)

    def items(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, (list, tuple)):
            raise MalformedError("wrong type")
        if len(value) > most:
            raise MalformedError("wrong length")
        return tuple([check(item) for item in value])

    return items


def _dataclass_checker(kind: type[Any]) -> Check:
    hints = get_type_hints(kind, include_extras=True)
    checks = {field.name: _checker(hints[field.name]) for field in fields(kind)}
    names = frozenset(checks)
    document: Any = kind  # mypy takes no class for hashable
    required = names - optionals(document).keys()

    def build(value: Any) -> Any:
        if not isinstance(value, dict):
            raise MalformedError("wrong type")
        if not required <= value.keys() <= names:
            raise MalformedError("wrong fields")
        return kind(**{name: check(value[name]) for name, check in checks.items() if name in value})

    return build


def _bounded(check: Check, bounds: list[Any]) -> Check:
    """A checker with the tightest of the bounds; no loop at run time, for every field of every message passes here."""
    between = [bound for bound in bounds if isinstance(bound, Between)]
    lengths = [bound for bound in bounds if isinstance(bound, Length)]

    def ranged(value: Any) -> Any:
        value = check(value)
        if not low <= value <= high:
            raise MalformedError("out of range")
        return value

    def measured(value: Any) -> Any:
        value = check(value)
        if not low <= len(value) <= high:
            raise MalformedError("wrong length")
        return value

    if between and lengths:
        return _bounded(_bounded(check, between), lengths)
    kept = between or lengths
    low, high = max(bound.low for bound in kept), min(bound.high for bound in kept)
    return ranged if between else measured


def _literal_checker(words: tuple[Any, ...]) -> Check:
    def literal(value: Any) -> Any:
        if type(value) is not str or value not in words:
            raise MalformedError("unknown word")
        return value

    return literal


def _optional_checker(options: tuple[Any, ...]) -> Check:
    (inner,) = [option for option in options if option is not type(None)]
    check = _checker(inner)
    return lambda value: None if value is None else check(value)


def _finite(value: Any) -> float:
    if type(value) not in (float, int):
        raise MalformedError("wrong type")
    try:
        number = float(value)
    except OverflowError:
        raise MalformedError("out of range") from None
    if not math.isfinite(number):
        raise MalformedError("not finite")
    return number


def _object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise MalformedError("wrong type")
    return value


def _mapping_checker(hint: Any) -> Check:
    check = _checker(hint)

    def mapping(value: Any) -> dict[str, Any]:
        return {name: check(each) for name, each in _object(value).items()}

    return mapping


def _text(value: Any) -> str:
    """Text that can travel: JSON may hold half a surrogate pair, which neither UTF-8 nor a journal takes."""
    if type(value) is not str:
        raise MalformedError("wrong type")
    if not value.isascii():
        try:
            value.encode()
        except UnicodeEncodeError:
            raise MalformedError("half a surrogate pair") from None
    return value


def _exactly(kind: type[Any]) -> Check:
    if kind is str:
        return _text

    def exactly(value: Any) -> Any:
        if type(value) is not kind:  # a bool is no count
            raise MalformedError("wrong type")
        return value

    return exactly
