"""A task's own options as flags give them: KEY=VALUE texts, or JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

from dreamfleet.common.errors import UsageError

PYTHON_LITERALS = {"True": True, "False": False, "None": None}


def parse_environment(text: str) -> dict[str, Any]:
    """The arguments of the environment in the JSON object of --task-options."""
    try:
        return dict(json.loads(text or "{}").get("environment", {}))
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise UsageError(f"--task-options must be a JSON object, not {text!r}") from error


def check_normalisation(options: str, observations: int) -> None:
    """`UsageError` if the normalisation in hand-written options does not fit so many observations."""
    try:
        normal = json.loads(options or "{}").get("normal")
        if normal is None:
            return
        mean, deviation = normal["mean"], normal["deviation"]
        whole = len(mean) == len(deviation) == observations and all(map(math.isfinite, (*mean, *deviation)))
        fits = whole and min(deviation) > 0
    except (TypeError, KeyError, ValueError, AttributeError, OverflowError, RecursionError):
        fits = False
    if not fits:
        raise UsageError(f"--task-options: normal must have a mean and a positive deviation of {observations} numbers")


def parse_arguments(flag: str, texts: Sequence[str], example: str) -> dict[str, Any]:
    """The values of a flag's KEY=VALUE texts by their keys; errors show `example`."""
    arguments = [_parse_argument(flag, text, example) for text in texts]
    if len(dict(arguments)) < len(arguments):
        raise UsageError(f"{flag}: a KEY stands there twice")
    return dict(arguments)


def _parse_argument(flag: str, text: str, example: str) -> tuple[str, Any]:
    name, equals, value = text.partition("=")
    if not (equals and name.isidentifier()):
        raise UsageError(f"{flag} {text!r}: write KEY=VALUE, such as {example}")
    if value in PYTHON_LITERALS:  # the Python spelling, as in gymnasium's documentation
        return name, PYTHON_LITERALS[value]
    try:
        return name, json.loads(value)
    except (ValueError, RecursionError):
        return name, value
