"""Conversion of plain data (JSON or msgpack) to frozen records and back; msgspec checks it against their type hints.

Messages in msgpack are msgspec's structs, which it checks alone. Documents in JSON are dataclasses. Of these, msgspec
leaves open which fields are missing or unknown. `from_plain` checks that too, and numbers and texts that only JSON has.
"""

import math
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import MISSING, field, fields, is_dataclass
from functools import cache
from threading import Lock
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, Struct

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.printable import truncate

Check = Callable[[Any], Any]
T = TypeVar("T")
MAX_TEXT = 2000  # characters: of an error, of why a worker is refused, of a fingerprint
SCHEMA = "schema"  # the reason of whatever does not fit its type hints (docs/reference/status.md)
MAX_SENTENCE = 200  # characters of why it does not: a peer may choose the name of a field
OPTIONAL = {"optional": True}
"""`field(default=..., metadata=OPTIONAL)`: a missing field has its default, and a default is not written."""


def added_option(default: Any, text: str) -> Any:
    """An `OPTIONAL` field that is a flag or a key of a file, with its help."""
    return field(default=default, metadata={**OPTIONAL, "help": text})


Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Finite = Annotated[float, Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
Seconds = Annotated[float, Meta(ge=0.0, le=1e9)]
Moment = Annotated[float, Meta(ge=0.0, le=253_402_300_799.0)]  # in seconds since 1970, to the year 9999
Digest = Annotated[bytes, Meta(min_length=32, max_length=32)]
Word = Annotated[str, Meta(min_length=1, max_length=128)]
Text = Annotated[str, Meta(max_length=MAX_TEXT)]


class MalformedError(DreamfleetError, ValueError):
    """Data does not fit its schema; `reason` is one of few, for counting."""

    def __init__(self, text: str, reason: str = "") -> None:
        super().__init__(text)
        self.reason = reason or text


class Packed(Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of what msgpack packs. A default is not written, and a missing field has it.

    msgspec leaves out what *is* the default, not what equals it. So a default is a word of a `Literal`, or a value that
    Python has only once: `None`, a bool, a small number, or an empty text or tuple.
    """


_first_use = Lock()
_used: set[Any] = set()


def convert(kind: type[T], plain: Any) -> T:
    """Build what msgspec alone checks, such as a message; `MalformedError` with its sentence if that does not fit."""
    if kind not in _used:
        _prepare(kind)
    try:
        return msgspec.convert(plain, kind, builtin_types=(bytes,))  # else it takes base64 for bytes
    except (msgspec.ValidationError, UnicodeEncodeError, AttributeError) as error:
        raise MalformedError(truncate(str(error), MAX_SENTENCE), SCHEMA) from error


def _prepare(kind: Any) -> None:
    """Let msgspec describe a type and those in it, in one thread: a second one would read a half-built description."""
    with _first_use:
        with suppress(msgspec.ValidationError):
            msgspec.convert(None, kind)
        _used.add(kind)


def from_plain(kind: type[T], plain: Any) -> T:
    """Build a dataclass from its plain form; `MalformedError` if that does not fit."""
    hint: Any = kind  # mypy takes no class for hashable
    return convert(kind, _open_check(hint, lenient=False)(plain))


def from_plain_lenient(kind: type[T], plain: Any) -> T:
    """Like `from_plain`, but ignores unknown fields at any depth, for documents of later versions."""
    hint: Any = kind  # mypy takes no class for hashable
    return convert(kind, _open_check(hint, lenient=True)(plain))


def to_plain(value: Any) -> Any:
    """Nested dataclasses as dictionaries, tuples as lists; unlike `dataclasses.asdict`, without copying vectors."""
    if isinstance(value, tuple):
        return [to_plain(item) for item in value]
    kind: Any = type(value)
    defaults = _defaults(kind)
    if not defaults:
        return value
    given = ((name, getattr(value, name), default) for name, default in defaults.items())
    return {name: to_plain(each) for name, each, default in given if default is MISSING or each != default}


@cache
def _open_check(hint: Any, *, lenient: bool) -> Check:
    """The check of what msgspec leaves open in a type; it returns the plain value without unknown fields.

    `MalformedError` for a missing field, for an unknown one unless `lenient`, for NaN, infinity, and a text with half a
    surrogate pair, which neither UTF-8 nor a journal can store.
    """
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _open_check(inner[0], lenient=lenient)
    if origin in (Union, UnionType):
        (option,) = (each for each in inner if each is not NoneType)
        return _open_check(option, lenient=lenient)
    if origin is tuple:
        item = _open_check(inner[0], lenient=lenient)
        if item is _same:
            return _same
        return lambda plain: [item(each) for each in plain] if isinstance(plain, (list, tuple)) else plain
    if origin is dict:
        value = _open_check(inner[1], lenient=lenient)
        if value is _same:
            return _same
        return lambda plain: {name: value(each) for name, each in plain.items()} if isinstance(plain, dict) else plain
    if is_dataclass(hint):
        return _dataclass_check(hint, lenient=lenient)
    return _refuse_infinite if hint is float else _refuse_half_pairs if hint is str else _same


def _dataclass_check(kind: Any, *, lenient: bool) -> Check:
    hints, defaults = get_type_hints(kind, include_extras=True), _defaults(kind)
    required = {name for name, default in defaults.items() if default is MISSING}
    checks = {name: _open_check(hints[name], lenient=lenient) for name in defaults}
    checks = {name: each for name, each in checks.items() if each is not _same}

    def check(plain: Any) -> Any:
        if not isinstance(plain, dict):
            return plain
        if not plain.keys() >= required:
            raise MalformedError(f"it lacks {', '.join(sorted(required - plain.keys()))}", SCHEMA)
        known = plain
        if unknown := plain.keys() - defaults.keys():
            if not lenient:
                raise MalformedError(truncate(f"it has unknown {', '.join(sorted(unknown))}", MAX_SENTENCE), SCHEMA)
            known = {name: value for name, value in plain.items() if name in defaults}
        return known | {name: each(known[name]) for name, each in checks.items() if name in known}

    return check


def _refuse_infinite(plain: Any) -> Any:
    if isinstance(plain, float) and not math.isfinite(plain):
        raise MalformedError(f"{plain} is not finite", SCHEMA)
    return plain


def _refuse_half_pairs(plain: Any) -> Any:
    if isinstance(plain, str) and not plain.isascii():
        try:
            plain.encode()
        except UnicodeEncodeError:
            raise MalformedError("a text has half a surrogate pair", SCHEMA) from None
    return plain


def _same(plain: Any) -> Any:
    return plain


@cache
def _defaults(kind: Any) -> dict[str, Any]:
    """Each field of a dataclass with its default if it is optional, else `MISSING`; empty for another type."""
    found = fields(kind) if is_dataclass(kind) else ()
    made = {each.name: each.default if each.default_factory is MISSING else each.default_factory() for each in found}
    return {each.name: made[each.name] if each.metadata.get("optional") else MISSING for each in found}
