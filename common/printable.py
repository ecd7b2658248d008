"""Texts of others as a terminal may show them."""

from __future__ import annotations


def printable(text: str) -> str:
    """The text with control characters, which a terminal would obey, as what they are written like."""
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)


def shortened(text: str, longest: int) -> str:
    """The text, printable and cut to `longest` characters, whatever its length and content."""
    text = printable(text[: longest + 1])  # what is cut off need not be looked at
    return text if len(text) <= longest else text[: longest - 3] + "..."
