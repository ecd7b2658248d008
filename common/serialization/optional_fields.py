"""Optional fields, which later versions added: a missing one has its default, and a default is not written."""

from __future__ import annotations

from dataclasses import MISSING, Field, asdict, fields, is_dataclass
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

OPTIONAL = {"optional": True}  # `field(default=..., metadata=OPTIONAL)`


@cache
def optional_defaults(kind: Any) -> dict[str, Any]:
    """The optional fields of a dataclass with their defaults."""
    return {each.name: _default(each) for each in fields(kind) if each.metadata.get("optional")}


def to_dict(document: Any) -> dict[str, Any]:
    """A dataclass as nested dictionaries without optional fields at their default."""
    plain = asdict(document)
    _drop_defaults(document, plain)
    return plain


def _drop_defaults(document: Any, plain: dict[str, Any]) -> None:
    kind: Any = type(document)
    defaults = optional_defaults(kind)
    for each in fields(document):
        value = getattr(document, each.name)
        if each.name in defaults and value == defaults[each.name]:
            del plain[each.name]
        elif is_dataclass(value):
            _drop_defaults(value, plain[each.name])
        elif isinstance(value, tuple) and value and is_dataclass(value[0]):
            for item, within in zip(value, plain[each.name], strict=True):
                _drop_defaults(item, within)


def _default(each: Field[Any]) -> Any:
    return each.default if each.default_factory is MISSING else each.default_factory()


def drop_unknown_fields(hint: Any, plain: Any) -> Any:
    """Remove the fields that the dataclasses of the type `hint` do not have, at any depth of a plain document."""
    origin = get_origin(hint)
    if origin is Annotated:
        return drop_unknown_fields(get_args(hint)[0], plain)
    if origin in (Union, UnionType):
        inner = [each for each in get_args(hint) if each is not NoneType]
        return drop_unknown_fields(inner[0], plain) if plain is not None and len(inner) == 1 else plain
    if origin is tuple and isinstance(plain, (list, tuple)):
        return [drop_unknown_fields(get_args(hint)[0], each) for each in plain]
    if is_dataclass(hint) and isinstance(plain, dict):
        kind: Any = hint  # mypy takes no class for hashable
        hints = _hints(kind)
        return {name: drop_unknown_fields(hints[name], value) for name, value in plain.items() if name in hints}
    return plain


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)
