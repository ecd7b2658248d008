"""Bounds of settings, as their annotations say them."""

from __future__ import annotations

from typing import Any, get_args, get_type_hints

from dreamfleet.common.errors import UsageError


def check_bounds(config: Any) -> None:
    """`UsageError` for a number outside the bounds in its field's annotation; `None` is within any."""
    for name, hint in get_type_hints(type(config), include_extras=True).items():
        value = getattr(config, name)
        for kind in (hint, *get_args(hint)):  # the second finds the parts of `Annotated[...] | None`
            for bounds in getattr(kind, "__metadata__", ()):
                if value is not None and not bounds.ge <= value <= bounds.le:
                    low, high = (f"{each:g}" if isinstance(each, float) else each for each in (bounds.ge, bounds.le))
                    raise UsageError(f"--{name.replace('_', '-')} must be from {low} to {high}, not {value}")
