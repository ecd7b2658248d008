"""What has arrived and waits for the owner thread: bounded by kind, in count and in bytes. Pure: sizes and a clock in.

Whatever comes over the wire is said again by whoever needs it to be heard: results and uploads until their verdict,
beats each interval, hellos until they are answered; a departure that was overlooked shows as silence. So what is too
much is dropped and counted: no flood fills the memory, and one of a kind leaves room for the others.
"""

from __future__ import annotations

import math
import queue
import threading
from collections import Counter
from dataclasses import dataclass
from typing import Any

from dreamfleet.common.messages import MAX_MESSAGE


@dataclass(frozen=True)
class Bound:
    """How much of a kind may wait; and how many may come in a second, a burst aside."""

    count: int
    size: int  # bytes
    rate: float = math.inf


BOUNDS = {
    "result": Bound(2048, 16 << 20),
    "beat": Bound(2048, 8 << 20),
    "upload": Bound(512, 20 << 20),
    "token": Bound(4096, 1),  # without a payload
    "hello": Bound(256, 4 << 20, 200.0),  # each costs what dozens of results cost, and who is not heard asks again
    "control": Bound(64, 1 << 20),
}


class Arrivals:
    """A queue that any thread may put into; one takes out."""

    def __init__(self, bounds: dict[str, Bound] = BOUNDS) -> None:
        self._bounds = bounds
        self._queue: queue.SimpleQueue[tuple[str, Any, int]] = queue.SimpleQueue()
        self._count: Counter[str] = Counter()
        self._size: Counter[str] = Counter()
        self._budget = {kind: (float(bound.count), -math.inf) for kind, bound in bounds.items()}  # how many, as of when
        self._dropped: Counter[str] = Counter()
        self._lock = threading.Lock()

    @property
    def dropped(self) -> Counter[str]:
        """What was not taken in, by reason."""
        with self._lock:
            return Counter(self._dropped)

    def put(self, kind: str, event: Any, size: int, now: float) -> bool:
        """Take in an event of so many bytes; whether there was room for it."""
        with self._lock:
            if why := self._refusal(kind, size, now):
                self._dropped[why] += 1
                return False
            self._count[kind] += 1
            self._size[kind] += size
        self._queue.put((kind, event, size))
        return True

    def wake(self) -> None:
        """End a wait without an event. Safe in a signal handler."""
        self._queue.put(("wake", None, 0))

    def get(self, timeout: float) -> tuple[str, Any]:
        """The oldest event, or `queue.Empty` after `timeout` seconds."""
        kind, event, size = self._queue.get(timeout=timeout)
        if kind != "wake":
            with self._lock:
                self._count[kind] -= 1
                self._size[kind] -= size
        return kind, event

    def _refusal(self, kind: str, size: int, now: float) -> str:
        bound = self._bounds[kind]
        if size > MAX_MESSAGE:
            return "oversize"
        if self._count[kind] >= bound.count or self._size[kind] + size > bound.size:
            return "too many at once"
        return "" if bound.rate == math.inf or self._spend(kind, bound, now) else "too many in a second"

    def _spend(self, kind: str, bound: Bound, now: float) -> bool:
        """Whether one more may come now: as many as may wait at once, and then `rate` a second."""
        left, then = self._budget[kind]
        left = min(left + bound.rate * max(now - then, 0.0), float(bound.count))
        enough = left >= 1.0
        self._budget[kind] = (left - enough, now)
        return enough
