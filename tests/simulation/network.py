"""What a worker and its coordinator are connected by: messages are lost, doubled, late and reordered, tokens vanish."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

LATENCY = 0.002  # virtual seconds: an undisturbed link keeps the order
GOLDEN = 0.6180339887  # its multiples are spread evenly and repeat no pattern

Way = Literal["up", "down"]


@dataclass(frozen=True)
class Effect:
    """What happens to messages until a moment."""

    kind: str
    until: float
    amount: float


@dataclass
class Link:
    """Of one host; it stays when the worker there is another."""

    cuts: int = 0  # that are on now
    sees: str | None = None  # the life of a coordinator whose token the worker there sees
    garbled: bool = False  # whether the next batch with jobs is damaged
    _effects: dict[Way, list[Effect]] = field(default_factory=lambda: {"up": [], "down": []})
    _count: int = 0

    def disturb(self, way: Way, effect: Effect) -> None:
        """One more effect, together with those that are on."""
        self._effects[way].append(effect)

    def fates(self, way: Way, now: float) -> Iterator[float]:
        """After how many seconds each copy of a message arrives."""
        if self.cuts:
            return
        effects = self._effects[way]
        if not effects:
            yield LATENCY
            return
        self._effects[way] = effects = [each for each in effects if each.until > now]
        delays = [LATENCY]
        for each in effects:
            self._count += 1
            if each.kind == "lose":
                delays = []
            elif each.kind == "double":
                delays += [delay + each.amount for delay in delays]
            elif each.kind == "delay":
                delays = [delay + each.amount for delay in delays]
            elif each.kind == "jumble":
                delays = [delay + each.amount * (self._count * GOLDEN % 1) for delay in delays]
        yield from delays[:8]
