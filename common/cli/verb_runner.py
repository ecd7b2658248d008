"""Run verbs from other verbs: found by entry point, their commands checked before anything runs."""

from __future__ import annotations

from importlib.metadata import entry_points

from dreamfleet.common.cli.command_line import GROUP, Verb, load_verb
from dreamfleet.common.errors import DreamfleetError


def find_verb(name: str) -> Verb:
    """The verb of an entry point's name, such as `train.vae`; `DreamfleetError` if none is installed."""
    points = entry_points(group=GROUP, name=name)
    if not points:
        raise DreamfleetError(f"no verb {name!r} is installed")
    return load_verb(next(iter(points)))
