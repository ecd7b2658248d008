"""Conversion of plain data (JSON or msgpack) to frozen dataclasses and back, checked against their type hints."""

from __future__ import annotations

import math
import types
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.serialization.optional_fields import drop_unknown_fields, optional_defaults

Check = Callable[[Any], Any]
T = TypeVar("T")
MAX_ITEMS = 4096  # of a list whose type has no bound
MAX_TEXT = 2000  # characters: of an error, of why a worker is refused, of a fingerprint


@dataclass(frozen=True)
class Between:
    """Inclusive bounds of a number."""

    low: float
    high: float


@dataclass(frozen=True)
class Length:
    """Inclusive bounds of the length of text (characters), bytes, or a list."""

    low: int
    high: int


Count = Annotated[int, Between(0, 2**63 - 1)]
Seconds = Annotated[float, Between(0.0, 1e9)]
Moment = Annotated[float, Between(0.0, 253_402_300_799.0)]  # in seconds since 1970, to the year 9999
Digest = Annotated[bytes, Length(32, 32)]
Word = Annotated[str, Length(1, 128)]
Text = Annotated[str, Length(0, MAX_TEXT)]


class MalformedError(DreamfleetError, ValueError):
    """Data does not fit its schema; `args[0]` is the reason, for counting or display."""


def from_plain(kind: type[T], plain: Any) -> T:
    """Build a dataclass from its plain form; `MalformedError` if that does not fit."""
    checked: T = checker_of(kind)(plain)
    return checked


def from_plain_lenient(kind: type[T], plain: Any) -> T:
    """Like `from_plain`, but ignores unknown fields at any depth, for documents of later versions."""
    return from_plain(kind, drop_unknown_fields(kind, plain))


def to_plain(value: Any) -> Any:
    """Nested dataclasses as dictionaries; unlike `dataclasses.asdict`, without copying vectors."""
    if isinstance(value, tuple):
        return [to_plain(item) for item in value]
    kind: Any = type(value)
    names = _field_names(kind)
    if not names:
        return value
    plain = {name: to_plain(getattr(value, name)) for name in names}
    for name, default in optional_defaults(kind).items():
        if getattr(value, name) == default:
            del plain[name]
    return plain


@cache
def _field_names(kind: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else ()


def checker_of(hint: Any) -> Check:
    """Compile a type annotation to a function that returns the checked value or raises `MalformedError`."""
    return _compile(hint)


@cache
def _compile(hint: Any) -> Check:
    if is_dataclass(hint) and isinstance(hint, type):
        return _dataclass_checker(hint)
    origin = get_origin(hint)
    if origin is Annotated:
        base, *bounds = get_args(hint)
        return _bounded_checker(_checker_for_items(base, bounds), bounds)
    if origin is tuple:
        return _checker_for_items(hint, [])
    if origin is Literal:
        return _literal_checker(get_args(hint))
    if origin in (Union, types.UnionType):
        return _optional_checker(get_args(hint))
    if hint is float:
        return _check_finite
    if origin is dict:
        return _check_object if get_args(hint)[1] is Any else _mapping_checker(get_args(hint)[1])
    return _type_checker(hint)


def _checker_for_items(hint: Any, bounds: list[Any]) -> Check:
    """A tuple's checker, which checks the length before the items."""
    if get_origin(hint) is not tuple:
        return checker_of(hint)
    check = checker_of(get_args(hint)[0])
    max_items = min([bound.high for bound in bounds if isinstance(bound, Length)], default=MAX_ITEMS)

    def items(value: Any) -> tuple[Any, ...]:
        if not isinstance(value, (list, tuple)):
            raise MalformedError("wrong type")
        if len(value) > max_items:
            raise MalformedError("wrong length")
        return tuple([check(item) for item in value])

    return items


def _dataclass_checker(kind: type[Any]) -> Check:
    hints = get_type_hints(kind, include_extras=True)
    names = [field.name for field in fields(kind)]
    document: Any = kind  # mypy takes no class for hashable
    required = frozenset(names) - optional_defaults(document).keys()
    scope = {"kind": kind, "names": frozenset(names), "required": required, "MalformedError": MalformedError}
    # As `copy` and `pickle` do: the constructor of a frozen dataclass takes longer than all checks.
    is_plain = not hasattr(kind, "__post_init__") and not any(
        each.default_factory is not MISSING for each in fields(kind)
    )
    scope |= {"new": object.__new__, "defaults": optional_defaults(document) if is_plain else {}}
    make = ["made_ = new(kind)", "made_.__dict__.update(made)", "return made_"] if is_plain else ["return kind(**made)"]
    lines = [
        "if not isinstance(value, dict):",
        "    raise MalformedError('wrong type')",
        "if value.keys() != required and not required <= value.keys() <= names:",
        "    raise MalformedError('wrong fields')",
        "made = {**defaults}",
    ]
    for name in names:
        within = _checked_field(scope, name, hints[name], f"value[{name!r}]", checker_of(hints[name]))
        within.append(f"made[{name!r}] = {name}_")
        lines += within if name in required else [f"if {name!r} in value:", *(f"    {line}" for line in within)]
    return _define("value", [*lines, *make], scope)


def to_checked_plain(value: Any) -> dict[str, Any]:
    """A dataclass as `to_plain` gives it; `MalformedError` if that breaks its schema."""
    kind: Any = type(value)
    plain: dict[str, Any] = _dumper(kind)(value)
    return plain


@cache
def _dumper(kind: Any) -> Check:
    hints, optional, scope = get_type_hints(kind, include_extras=True), optional_defaults(kind), dict[str, Any]()
    lines = ["plain = {}"]
    for name in _field_names(kind):
        within = _checked_field(scope, name, hints[name], f"value.{name}", _plain_checker(hints[name]))
        within.append(f"plain[{name!r}] = {name}_")
        if name in optional:
            scope[f"{name}_default"] = optional[name]
            within = [f"if not value.{name} == {name}_default:", *(f"    {line}" for line in within)]
        lines += within
    return _define("value", [*lines, "return plain"], scope)


def _plain_checker(hint: Any) -> Check:
    """A function that returns a field's plain form if that fits."""
    check = checker_of(hint)

    def dump(value: Any) -> Any:
        plain = to_plain(value)
        check(plain)
        return plain

    base, *bounds = get_args(hint) if get_origin(hint) is Annotated else (hint,)
    kind: Any = get_args(base)[0] if get_origin(base) is tuple else None
    if bounds or not _field_names(kind):
        return dump
    dump_item = _dumper(kind)

    def dump_items(value: Any) -> Any:
        if isinstance(value, tuple) and len(value) <= MAX_ITEMS and all(type(each) is kind for each in value):
            return [dump_item(each) for each in value]
        return dump(value)

    return dump_items


def _checked_field(scope: dict[str, Any], name: str, hint: Any, source: str, check: Check) -> list[str]:
    """The lines that set `name_` to a checked field; `check` is called only if a short condition does not hold."""
    scope[f"{name}_check"] = check
    condition = _condition(hint, f"{name}_", scope)
    if condition is None:
        return [f"{name}_ = {name}_check({source})"]
    return [f"{name}_ = {source}", f"if not ({condition}): {name}_ = {name}_check({name}_)"]


def _condition(hint: Any, x: str, scope: dict[str, Any]) -> str | None:
    """An expression that holds only for values of `x` that a hint's checker returns as they are; `None`: there is none.

    Generated code is ten times as fast as nested functions, and every field of every job passes here.
    """
    origin = get_origin(hint)
    if origin is Annotated:
        base, *bounds = get_args(hint)
        found = _condition(base, x, scope)
        measured = {Between: x, Length: f"len({x})"}
        limits = [f"{each.low!r} <= {measured[type(each)]} <= {each.high!r}" for each in bounds]
        return None if found is None else " and ".join([found, *limits])
    if origin is Literal:
        scope[f"{x}words"] = get_args(hint)
        return f"type({x}) is str and {x} in {x}words"
    if origin in (Union, types.UnionType):
        (inner,) = [option for option in get_args(hint) if option is not type(None)]
        found = _condition(inner, x, scope)
        return None if found is None else f"{x} is None or {found}"
    if hint is float:
        return f"type({x}) is float and {x} - {x} == 0.0"  # finite
    if hint is str:
        return f"type({x}) is str and {x}.isascii()"
    return f"type({x}) is {hint.__name__}" if hint in (int, bytes, bool) else None


def _define(parameter: str, lines: list[str], scope: dict[str, Any]) -> Check:
    """The function of one parameter with these lines."""
    body = "".join(f"    {line}\n" for line in lines)
    exec(f"def compiled({parameter}):\n{body}", scope)  # noqa: S102 - made from this package's own annotations
    compiled: Check = scope["compiled"]
    return compiled


def _bounded_checker(check: Check, bounds: list[Any]) -> Check:
    """A checker of the tightest bounds, computed once: every field of every message passes through it."""
    between = [bound for bound in bounds if isinstance(bound, Between)]
    lengths = [bound for bound in bounds if isinstance(bound, Length)]

    def check_range(value: Any) -> Any:
        value = check(value)
        if not low <= value <= high:
            raise MalformedError("out of range")
        return value

    def check_length(value: Any) -> Any:
        value = check(value)
        if not low <= len(value) <= high:
            raise MalformedError("wrong length")
        return value

    if between and lengths:
        return _bounded_checker(_bounded_checker(check, between), lengths)
    kept = between or lengths
    low, high = max(bound.low for bound in kept), min(bound.high for bound in kept)
    return check_range if between else check_length


def _literal_checker(words: tuple[Any, ...]) -> Check:
    def literal(value: Any) -> Any:
        if type(value) is not str or value not in words:
            raise MalformedError("unknown word")
        return value

    return literal


def _optional_checker(options: tuple[Any, ...]) -> Check:
    (inner,) = [option for option in options if option is not type(None)]
    check = checker_of(inner)
    return lambda value: None if value is None else check(value)


def _check_finite(value: Any) -> float:
    if type(value) not in (float, int):
        raise MalformedError("wrong type")
    try:
        number = float(value)
    except OverflowError:
        raise MalformedError("out of range") from None
    if not math.isfinite(number):
        raise MalformedError("not finite")
    return number


def _check_object(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise MalformedError("wrong type")
    return value


def _mapping_checker(hint: Any) -> Check:
    check = checker_of(hint)

    def mapping(value: Any) -> dict[str, Any]:
        return {name: check(each) for name, each in _check_object(value).items()}

    return mapping


def _check_text(value: Any) -> str:
    """Check a text; JSON may contain half a surrogate pair, which neither UTF-8 nor a journal can store."""
    if type(value) is not str:
        raise MalformedError("wrong type")
    if not value.isascii():
        try:
            value.encode()
        except UnicodeEncodeError:
            raise MalformedError("half a surrogate pair") from None
    return value


def _type_checker(kind: type[Any]) -> Check:
    if kind is str:
        return _check_text

    def exactly(value: Any) -> Any:
        if type(value) is not kind:  # not isinstance: a bool is no count
            raise MalformedError("wrong type")
        return value

    return exactly
