"""How many drives a slot does side by side. Pure."""

from __future__ import annotations

import statistics
from collections import deque

WINDOW = 5  # groups whose median counts
ENOUGH = 3  # measured groups before a number is compared
MEASURE_AGAIN = 64  # groups after which a number that is not the best is tried once more


class DriveCount:
    """Finds, from the drives themselves, how many side by side take least time a step on this host.

    That depends on the processor and its caches, on the world and on the other slots. No score depends on it. The
    powers of two up to `most`, and `most` itself, are tried in turn, from the largest down.

    >>> count = DriveCount()
    >>> count.most = 4
    >>> for drives, seconds in [(4, 1.6), (2, 0.7), (1, 0.4)] * ENOUGH:
    ...     count.add(drives, steps=1000 * drives, seconds=seconds)
    >>> count.best
    2
    """

    def __init__(self) -> None:
        self._most = 1
        self._costs: dict[int, deque[float]] = {1: deque(maxlen=WINDOW)}  # seconds a step, by number of drives
        self._groups = 0
        self._measured_at: dict[int, int] = {}  # by number of drives, the group that was measured last

    @property
    def most(self) -> int:
        """The largest number that a slot can do; what was measured is forgotten where it changes."""
        return self._most

    @most.setter
    def most(self, most: int) -> None:
        if most != self._most:
            self._most = most
            sizes = {2**power for power in range(most.bit_length())} | {most}
            self._costs = {size: deque(maxlen=WINDOW) for size in sorted(sizes, reverse=True)}
            self._groups, self._measured_at = 0, {}

    def add(self, drives: int, steps: int, seconds: float) -> None:
        """Note a finished group: its number of drives, the steps of all of them, and how long it took."""
        if drives in self._costs:
            self._groups += 1
            self._costs[drives].append(seconds / max(steps, 1))
            self._measured_at[drives] = self._groups

    @property
    def best(self) -> int:
        """The number whose step takes least; the largest until all are measured."""
        if any(len(costs) < ENOUGH for costs in self._costs.values()):
            return self._most
        return min(self._costs, key=lambda size: statistics.median(self._costs[size]))

    @property
    def next(self) -> int:
        """The number for the next group: one that lacks measurements, or the best."""
        for size, costs in self._costs.items():
            if len(costs) < ENOUGH or self._groups - self._measured_at[size] >= MEASURE_AGAIN:
                return size
        return self.best
