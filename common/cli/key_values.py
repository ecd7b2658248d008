"""KEY=VALUE texts of flags."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from dreamfleet.common.errors import UsageError

PYTHON_LITERALS = {"True": True, "False": False, "None": None}
ENVIRONMENT_EXAMPLE = "continuous=true"


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


def as_setting(flag: str, values: Sequence[str]) -> str:
    """What `--set` takes instead of a flag.

    >>> as_setting("--decoder-channels", ("64", "32")), as_setting("--done", ()), as_setting("--no-done", ())
    ('decoder_channels=64,32', 'done=true', 'done=false')
    """
    name = flag.removeprefix("--").replace("-", "_")
    if not values:
        return f"{name.removeprefix('no_')}={'false' if name.startswith('no_') else 'true'}"
    return f"{name}={','.join(values)}"
