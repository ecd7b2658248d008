"""How many drives a slot does side by side. Pure. Pages: tasks.md, decisions.md."""

import statistics
from collections import deque

WINDOW = 5  # groups whose median counts
ENOUGH = 3  # measured groups before a number is compared
MEASURE_AGAIN = 64  # groups after which a number that is not the best is tried once more


class DriveCount:
    """Finds, from the drives themselves, how many side by side take least time a step on this host.

    That depends on the processor and its caches, on the world and on the other slots. No score depends on it. The
    largest number that there is work for is tried, then the powers of two below it.
    """

    def __init__(self) -> None:
        self._most = 0
        self.most = 1

    @property
    def most(self) -> int:
        """The largest number that a slot can do; what was measured is forgotten where it changes."""
        return self._most

    @most.setter
    def most(self, most: int) -> None:
        if most != self._most:
            self._most = most
            # Seconds a step, and the group that was measured last, by number of drives.
            self._costs = {size: deque[float](maxlen=WINDOW) for size in range(1, most + 1)}
            self._measured_at = dict.fromkeys(self._costs, 0)
            self._groups = 0

    def add(self, drives: int, steps: int, seconds: float) -> None:
        """Note a finished group: its number of drives, the steps of all of them, and how long it took."""
        if drives in self._costs:
            self._groups += 1
            self._costs[drives].append(seconds / max(steps, 1))
            self._measured_at[drives] = self._groups

    @property
    def best(self) -> int:
        """The number whose step takes least; the largest until all are measured."""
        sizes = self._sizes(self._most)
        return self._cheapest(sizes) if all(map(self._is_measured, sizes)) else self._most

    def choose(self, waiting: int) -> int:
        """The number for the next group of at most `waiting` drives: one that lacks measurements, or the best."""
        sizes = self._sizes(max(1, min(waiting, self._most)))
        for size in sizes:
            if not self._is_measured(size) or self._groups - self._measured_at[size] >= MEASURE_AGAIN:
                return size
        return self._cheapest(sizes)

    def _sizes(self, largest: int) -> list[int]:
        """The largest number, and the powers of two below it, in falling order."""
        return [largest, *(2**power for power in reversed(range((largest - 1).bit_length())))]

    def _is_measured(self, size: int) -> bool:
        return len(self._costs[size]) >= ENOUGH

    def _cheapest(self, sizes: list[int]) -> int:
        return min(sizes, key=lambda size: statistics.median(self._costs[size]))
