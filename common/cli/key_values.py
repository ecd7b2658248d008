"""Texts of flags: KEY=VALUE, and flags of another verb. Pages: tasks.md, rounds.md."""

import json
import shlex
from collections.abc import Sequence
from typing import Any

from dreamfleet.common.errors import UsageError

PYTHON_LITERALS = {"True": True, "False": False, "None": None}
ENVIRONMENT_EXAMPLE = "continuous=true"


def split_flags(flag: str, text: str, owner: str = "", reserved: Sequence[str] = ()) -> tuple[str, ...]:
    """Flags of another verb that `flag` was given as one text.

    `UsageError` if quotes do not match, or if one is in `reserved`, which `owner` sets itself.
    """
    try:
        words = tuple(shlex.split(text))
    except ValueError as error:
        raise UsageError(f"{flag} {text!r}: {error}") from error
    given = {word.partition("=")[0] for word in words if word.startswith("--")}
    if taken := [each for each in reserved if any(each.startswith(word) for word in given)]:  # a short form too
        raise UsageError(f"{flag}: omit {', '.join(taken)}, which {owner} sets itself")
    return words


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
