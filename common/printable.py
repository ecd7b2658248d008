"""Texts of others as a terminal may show them."""

from __future__ import annotations

import logging
from collections.abc import Sequence


def printable(text: str) -> str:
    """The text with control characters, which a terminal would obey, as what they are written like."""
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)


def truncate(text: str, longest: int) -> str:
    """The text, printable and cut to `longest` characters, whatever its length and content."""
    text = printable(text[: longest + 1])  # what is cut off need not be looked at
    return text if len(text) <= longest else text[: longest - 3] + "..."


def one_line(text: str) -> str:
    """The text on one line, and printable: what came over the wire cannot begin a line of its own."""
    return printable(" ".join(text.split()))


def plural(count: float, noun: str, nouns: str = "") -> str:
    """A number with its noun, of which there may be one: 1 seed, 1,000 seeds, 1.5 minutes, 2 batches."""
    return f"{count:{',' if isinstance(count, int) else 'g'}} {noun if count == 1 else nouns or f'{noun}s'}"


def join_some(names: Sequence[str], most: int) -> str:
    """The first `most` of the names, and how many more there are: a, b and 3 more."""
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def format_setting(value: object) -> str:
    """A setting's value as people write it: yes or no, a number in six digits, a list with commas."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    return ", ".join(map(format_setting, value)) if isinstance(value, (list, tuple)) else str(value)


def printable_lines(text: str) -> str:
    """Each line printable, of a text whose lines are our own."""
    return "\n".join(map(printable, text.split("\n")))


class PrintableFormatter(logging.Formatter):
    """Log lines in which no text of others is obeyed by a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """The lines of one record."""
        return printable_lines(super().format(record))
