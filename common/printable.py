"""Untrusted text made safe for a terminal, and values formatted for people."""

import math
import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches

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

    `sign` is `+` if positive numbers show theirs. What is tiny or huge counts alike in dom.js.

    >>> format_number(875.62), format_number(-3.98712), format_number(0.00004127), format_number(12345.6)
    ('875.6', '-3.987', '4.127e-05', '12,346')
    >>> format_number(21), format_number(None), format_number(0.5, "+")
    ('21.0', '-', '+0.5')
    """
    if value is None or math.isnan(value):
        return "-"
    if 999.95 <= abs(value) < 1e12:
        return f"{value:{sign},.0f}"
    text = f"{value:{sign}z.4g}"
    return text if {".", "e", "f"} & set(text) else f"{text}.0"


def format_duration(seconds: float) -> str:
    """Format a duration: 0.25 s, 4.6 s, 48 s, 12 min, 3 h 20 min, 5 d 2 h."""
    if not math.isfinite(seconds):
        return "very long"
    if seconds < 59.5:
        return f"{seconds:.2g} s" if seconds < 9.95 else f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 60:
        return f"{minutes} min"
    hours, minutes = divmod(minutes, 60)
    if hours < 48:
        return f"{hours} h {minutes} min" if minutes else f"{hours} h"
    days, hours = divmod(round(seconds / 3600), 24)
    return f"{days:,} d {hours} h" if hours else f"{days:,} d"


def suggest(name: str, known: Iterable[str], *, likeness: float = 0.6, listed: bool = True) -> str:
    """The end of an error text about an unknown name: the nearest known one, if it is that like; else all if `listed`.

    >>> suggest("populate", ["population", "seed"]), suggest("x", ["population", "seed"])
    (": did you mean 'population'?", '; known are population, seed')
    """
    names = list(known)
    near = get_close_matches(name, names, n=1, cutoff=likeness)
    return did_you_mean(near) if near else f"; known are {', '.join(names)}" if listed else ""


def did_you_mean(names: Iterable[str]) -> str:
    """The end of an error text that suggests these names.

    >>> did_you_mean(["stop", "drain"])
    ": did you mean 'stop' or 'drain'?"
    """
    return f": did you mean {' or '.join(map(repr, names))}?"


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
