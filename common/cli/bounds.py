"""Bounds of settings, as their annotations say them."""

import sys
from typing import Annotated, Any, get_args, get_type_hints

from msgspec import Meta

from dreamfleet.common.errors import UsageError

Positive = Annotated[int, Meta(ge=1, le=2**63 - 1)]
NotNegative = Annotated[float, Meta(ge=0.0, le=sys.float_info.max)]


def check_bounds(config: Any, *, are_flags: bool = True) -> None:
    """`UsageError` for a number or a text's length outside the bounds in its field's annotation; `None` is within any.

    It names the flag, or the key where the fields are not flags.
    """
    for name, hint in get_type_hints(type(config), include_extras=True).items():
        value = getattr(config, name)
        for kind in (hint, *get_args(hint)):  # the second finds the parts of `Annotated[...] | None`
            for bounds in getattr(kind, "__metadata__", ()):
                named = f"--{name.replace('_', '-')}" if are_flags else name
                if isinstance(value, str):
                    if bounds.max_length is not None and len(value) > bounds.max_length:
                        raise UsageError(f"{named} has at most {bounds.max_length} characters, not {len(value)}")
                elif value is not None and not bounds.ge <= value <= bounds.le:
                    low, high = (f"{each:g}" if isinstance(each, float) else each for each in (bounds.ge, bounds.le))
                    raise UsageError(f"{named} must be from {low} to {high}, not {value}")
