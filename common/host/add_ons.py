"""What add-ons offer the core, by entry point: the core imports none, and starts without them."""

from importlib.metadata import entry_points
from typing import Any

from dreamfleet.common.errors import UsageError


def load_registered(group: str, name: str | None = None) -> dict[str, Any]:
    """What is registered in a group of entry points, by name, or under one name; not where its module is missing.

    `ModuleNotFoundError` if a package of others that one needs is missing.
    """
    found = {}
    for point in entry_points(group=group):
        try:
            if name in (None, point.name):
                found[point.name] = point.load()
        except ModuleNotFoundError as error:
            if not (error.name and point.module.startswith(error.name)):
                raise
    return found


def find_add_on(name: str) -> Any | None:
    """What is registered under this name in `dreamfleet.addons`; `None` if nothing is. Errors as `load_registered`."""
    return load_registered("dreamfleet.addons", name).get(name)


def add_on(name: str) -> Any:
    """As `find_add_on`; `UsageError` if there is none."""
    found = find_add_on(name)
    if found is None:
        raise UsageError(f"this installation lacks the add-on {name!r}: pip install --force-reinstall dreamfleet")
    return found
