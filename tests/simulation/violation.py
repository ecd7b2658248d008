"""A rule that was broken."""

from __future__ import annotations


class Violation(Exception):  # noqa: N818 - it is what is looked for
    """Which `rule`, and how."""

    def __init__(self, rule: str, how: str) -> None:
        super().__init__(f"{rule}: {how}")
        self.rule = rule
