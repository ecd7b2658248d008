"""Untrusted text made safe for a terminal, and values formatted for people."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

KEPT_OF_HUGE_WORD = 100  # characters kept at each end
_HUGE_WORD = re.compile(r"\S{1000,}")


def printable(text: str) -> str:
    """The text with control characters, which a terminal would execute, as escape sequences."""
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)


def truncate(text: str, max_chars: int) -> str:
    """The text, printable and cut to `max_chars` characters."""
    text = printable(text[: max_chars + 1])
    return text if len(text) <= max_chars else text[: max_chars - 3] + "..."


def one_line(text: str) -> str:
    """The text on one line, printable: text from the network cannot start a line."""
    return printable(" ".join(text.split()))


def shorten_words(text: str) -> str:
    """The text with the middle of huge words left out, such as a name of 5,000 characters; its remedy stays."""
    return _HUGE_WORD.sub(lambda word: f"{word[0][:KEPT_OF_HUGE_WORD]}...{word[0][-KEPT_OF_HUGE_WORD:]}", text)


def plural(count: float, noun: str, nouns: str = "") -> str:
    """Format a number with its noun in singular or plural: 1 seed, 1,000 seeds, 1.5 minutes, 2 batches."""
    return f"{count:{'g' if isinstance(count, float) else ','}} {noun if count == 1 else nouns or f'{noun}s'}"


def format_number(value: float | None, sign: str = "") -> str:
    """Format a measured number in four significant digits, from a thousand on all whole ones; - if it is missing.

    `sign` is `+` if positive numbers show theirs, `,` if thousands have commas, or both.

    >>> format_number(875.62), format_number(-3.98712), format_number(0.00004127), format_number(12345.6)
    ('875.6', '-3.987', '4.127e-05', '12346')
    >>> format_number(21), format_number(None), format_number(0.5, "+")
    ('21.0', '-', '+0.5')
    """
    if value is None or math.isnan(value):
        return "-"
    plus, comma = "+" if "+" in sign else "", "," if "," in sign else ""
    if 999.95 <= abs(value) < 1e12:
        return f"{value:{plus}{comma}.0f}"
    text = f"{value:{plus}z.4g}"
    return text if {".", "e", "f"} & set(text) else f"{text}.0"


def join_some(names: Sequence[str], limit: int) -> str:
    """The first `limit` names and the number of others: a, b and 3 more."""
    more = f" and {len(names) - limit:,} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


def format_setting(value: object) -> str:
    """Format a setting's value: yes or no, a number in six digits, a list with commas."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:zg}"
    return ", ".join(map(format_setting, value)) if isinstance(value, (list, tuple)) else str(value)


def printable_lines(text: str) -> str:
    """The text with each of its lines printable; its line breaks are trusted."""
    return "\n".join(map(printable, text.split("\n")))
