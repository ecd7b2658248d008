"""A task's own options as JSON."""

from __future__ import annotations

import json
import math
from typing import Any

from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural


def parse_described(text: str) -> dict[str, Any]:
    """The options by which a task describes itself, of those in the JSON object of --task-options."""
    try:
        plain = json.loads(text or "{}")
        observation = {"observation": list(plain["observation"])} if plain.get("observation") else {}
        return {"environment": dict(plain.get("environment", {})), **observation}
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
        raise UsageError(
            f"--task-options: normal must have a mean and a positive deviation of {plural(observations, 'number')}"
        )
