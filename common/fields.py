"""Fields that a later version added to a document: absent means the default, and a default is not written."""

from __future__ import annotations

from dataclasses import MISSING, Field, asdict, fields
from functools import cache
from typing import Any

OPTIONAL = {"optional": True}  # `field(default=..., metadata=OPTIONAL)`


@cache
def optionals(kind: Any) -> dict[str, Any]:
    """The optional fields of a dataclass with their defaults."""
    return {each.name: _default(each) for each in fields(kind) if each.metadata.get("optional")}


def written(document: Any) -> dict[str, Any]:
    """A dataclass as a dictionary without optional fields at their default, also of dataclasses within."""
    plain = asdict(document)
    _drop_defaults(document, plain)
    return plain


def _drop_defaults(document: Any, plain: dict[str, Any]) -> None:
    kind: Any = type(document)
    defaults = optionals(kind)
    for each in fields(document):
        value = getattr(document, each.name)
        if each.name in defaults and value == defaults[each.name]:
            del plain[each.name]
        elif hasattr(value, "__dataclass_fields__"):
            _drop_defaults(value, plain[each.name])


def _default(each: Field[Any]) -> Any:
    return each.default if each.default_factory is MISSING else each.default_factory()
