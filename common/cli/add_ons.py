"""What add-ons offer the core, by entry point: the core imports none, and starts without them."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from dreamfleet.common.errors import UsageError

GROUP = "dreamfleet.addons"


def find_add_on(name: str) -> Any | None:
    """What is registered under this name in `GROUP`; `None` if nothing is, or if its module is not installed.

    `ModuleNotFoundError` if a package of others that it needs is missing.
    """
    for point in entry_points(group=GROUP, name=name):
        try:
            return point.load()
        except ModuleNotFoundError as error:
            if not (error.name and point.module.startswith(error.name)):
                raise
    return None


def add_on(name: str) -> Any:
    """As `find_add_on`; `UsageError` if there is none."""
    found = find_add_on(name)
    if found is None:
        raise UsageError(f"this installation lacks the add-on {name!r}: pip install --force-reinstall dreamfleet")
    return found
