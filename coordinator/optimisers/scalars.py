"""Single numbers as JSON that comes back with the same bits and the same type.

The type matters: Python's float and NumPy's do not take every operation through the same routine.
"""

from __future__ import annotations

from typing import Any

import numpy as np

SCALARS = (bool, int, float, str, type(None), np.bool_, np.integer, np.floating)


def tag(value: Any) -> list[Any]:
    """A scalar with its type; floats as hexadecimal."""
    if isinstance(value, (float, np.floating)):
        return [type(value).__name__, float(value).hex()]
    if isinstance(value, (np.integer, np.bool_)):
        return [type(value).__name__, value.item()]
    return ["plain", value]


def untag(tagged: list[Any]) -> Any:
    """The scalar that `tag` was given."""
    kind, value = tagged
    if kind == "plain":
        return value
    number = float.fromhex(value) if isinstance(value, str) else value
    return number if kind == "float" else np.dtype(kind.rstrip("_")).type(number)
