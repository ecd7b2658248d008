"""How objects that users hold look: one line in a REPL, a small table in a notebook. Pages: python.md."""

from dataclasses import MISSING, fields
from html import escape
from typing import Any

from dreamfleet.common.printable import format_setting, one_line, truncate

MAX_CELL = 200  # characters of a table's cell


class Displayed:
    """Base of what users hold; a subclass defines `_display`. A dataclass is declared with `repr=False`.

    >>> class Pole(Displayed):
    ...     def _display(self):
    ...         return "Pole of 1 m", {"length": "1 m", "stands": True}
    >>> Pole()
    <Pole of 1 m>
    >>> "<th>stands</th><td>yes</td>" in Pole()._repr_html_()
    True
    """

    def _display(self) -> tuple[str, dict[str, object]]:
        """The object in one line, and its facts by name; facts that are `None` are left out."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{one_line(self._display()[0])}>"

    def _repr_html_(self) -> str:
        """The table that notebooks show."""
        headline, facts = self._display()
        rows = "".join(
            f"<tr><th>{escape(name)}</th><td>{escape(truncate(format_setting(value), MAX_CELL))}</td></tr>"
            for name, value in facts.items()
            if value is not None
        )
        return f"<table><caption>{escape(one_line(headline))}</caption>{rows}</table>"


class DisplayedFields(Displayed):
    """Base of dataclasses with many fields: shows those that differ from their defaults, as Python writes them."""

    def _display(self) -> tuple[str, dict[str, object]]:
        return repr(self), _changed_fields(self)

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value!r}" for name, value in _changed_fields(self).items())
        return f"{type(self).__name__}({values})"


def _changed_fields(record: Any) -> dict[str, Any]:
    """The fields of a dataclass that differ from their defaults, or have none."""
    found = {}
    for each in fields(record):
        value = getattr(record, each.name)
        default = each.default if each.default_factory is MISSING else each.default_factory()
        if default is MISSING or value != default:
            found[each.name] = value
    return found
