"""Untrusted text in Markdown: it shows as it is, and is no markup."""

import re

from dreamfleet.common.printable import one_line


def as_text(text: str) -> str:
    """A text as Markdown that shows it on one line as it is: no markup, no HTML, no list, no heading."""
    escaped = re.sub(r"[\\`*_\[\]<>&|~$]", r"\\\g<0>", one_line(text))
    return re.sub(r"^(\d*)([#+=.)-])(?!\d)", r"\1\\\2", escaped)


def as_code(text: str) -> str:
    """A text as a code span on one line, which no backtick in it ends."""
    text = one_line(text)
    fence = fence_of(text, 1)
    pad = " " if "`" in text else ""
    return f"{fence}{pad}{text}{pad}{fence}"


def fence_of(text: str, least: int = 3) -> str:
    """The backticks, `least` or more, around a code span or block of this text, which does not end them."""
    return "`" * max(least, 1 + max(map(len, re.findall("`+", text)), default=0))
