"""One section of the page."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Section:
    """A title, what to look for, and a picture (PNG) or none; `name` is its file's."""

    name: str
    title: str
    text: str
    picture: bytes | None = None
