"""Options of a task as text: a JSON object, which is empty where every option has its default."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any

from dreamfleet.common.errors import UsageError


def read_options(task: str, text: str, known: Collection[str]) -> dict[str, Any]:
    """The options by name; `UsageError` for what is no JSON object, or names an option that is not `known`.

    >>> read_options("mine", '{"speed": 2}', ("speed",))
    {'speed': 2}
    """
    try:
        names = json.loads(text or "{}")
        if not isinstance(names, dict):
            raise TypeError("it is not an object")
    except (ValueError, TypeError, RecursionError) as error:
        raise UsageError(f"{task}'s options must be a JSON object, not {text!r:.200}") from error
    check_options(task, names, known)
    return names


def check_options(task: str, names: Collection[str], known: Collection[str]) -> None:
    """`UsageError` for a name that is not `known`."""
    if unknown := sorted(set(names) - set(known)):
        raise UsageError(f"{task} knows no option {', '.join(unknown):.200}: known are {', '.join(known)}")


def write_options(changed: Mapping[str, Any]) -> str:
    """The options that differ from their defaults as canonical JSON; empty if none does.

    >>> write_options({"speed": 2, "colour": "red"}), write_options({})
    ('{"colour": "red", "speed": 2}', '')
    """
    return json.dumps(changed, sort_keys=True) if changed else ""
