"""How much of a run was checked by other hosts, and what came of it. Pages: status.md, trust.md."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from dreamfleet.common.printable import plural, printable, truncate
from dreamfleet.common.protocol.messages import Share
from dreamfleet.common.schema.validation import MAX_TEXT, OPTIONAL, Count, Text

MAX_BARRED = 16  # hosts that are named
BY_OPERATOR = " (by the operator)"  # behind the name of a host that no check found wrong


@dataclass(frozen=True)
class CheckCounts:
    """Results that another host scored again, and hosts that were barred.

    >>> CheckCounts(0.02, 40, 0, 3).description
    '2% of the results: 40 checked, all equal, 3 unchecked for want of another host of their class'
    """

    share: Share  # of the results that are drawn
    checked: Count = 0  # drawn results that another host repeated, equal or not
    differing: Count = 0  # of these, those that some host did not repeat to the bit
    unchecked: Count = 0  # drawn results that no other host of their class could repeat
    recalled: Count = field(default=0, metadata=OPTIONAL)  # results of barred hosts that count no more
    barred: Annotated[tuple[Text, ...], Meta(max_length=MAX_BARRED)] = field(default=(), metadata=OPTIONAL)
    # Of the barred hosts, those that the operator named: no check found them wrong.
    by_operator: Annotated[tuple[Text, ...], Meta(max_length=MAX_BARRED)] = field(default=(), metadata=OPTIONAL)
    waiting: Text = field(default="", metadata=OPTIONAL)  # which hosts differ, while nobody has decided between them

    @classmethod
    def of(
        cls, share: float, counts: Mapping[str, int], bars: Iterable[tuple[str, bool]], waiting: str = ""
    ) -> CheckCounts | None:
        """By the numbers of outcomes and of `recalled` results, and the barred hosts, by the operator or not.

        `None` if no share is checked, nothing was, and nobody is barred. Of many hosts the last ones are named.
        """
        found, last = Counter(counts), [(truncate(host, MAX_TEXT), named) for host, named in [*bars][-MAX_BARRED:]]
        if not (share or last or any(counts.values())):
            return None
        return cls(
            share, found["equal"] + found["differs"], found["differs"], found["unchecked"], found["recalled"],
            tuple(host for host, _ in last), tuple(host for host, named in last if named), truncate(waiting, MAX_TEXT),
        )  # fmt: skip

    @property
    def description(self) -> str:
        """A text for display."""
        equal = "all equal" if not self.differing else f"{self.differing} with a difference"
        parts = [f"{self.checked} checked, {equal}"] if self.checked else ["none checked yet"] if self.share else []
        if self.unchecked:
            parts.append(f"{self.unchecked} unchecked for want of another host of their class")
        if self.recalled:
            parts.append(f"{plural(self.recalled, 'result')} recalled")
        if self.barred:
            named = (f"{printable(each)}{BY_OPERATOR if each in self.by_operator else ''}" for each in self.barred)
            parts.append(f"barred: {', '.join(named)}")
        of = f"{100 * self.share:.3g}% of the results: " if self.share else ""
        return f"{of}{', '.join(parts)}"
