"""Bounds of values that are checked as they are read: ranges of numbers, lengths of texts, bytes and lists."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

MAX_TEXT = 2000  # characters: of an error, of why a worker is refused, of a fingerprint


@dataclass(frozen=True)
class Between:
    """Inclusive bounds of a number."""

    low: float
    high: float


@dataclass(frozen=True)
class Length:
    """Inclusive bounds of the length of text (characters), bytes, or a list."""

    low: int
    high: int


Count = Annotated[int, Between(0, 2**63 - 1)]


Seconds = Annotated[float, Between(0.0, 1e9)]


Digest = Annotated[bytes, Length(32, 32)]


Word = Annotated[str, Length(1, 128)]


Text = Annotated[str, Length(0, MAX_TEXT)]
