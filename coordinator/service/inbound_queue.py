"""Events that wait for the service's thread: bounded per kind, in count and in bytes. Pure: sizes and a clock in.

Senders repeat what matters: results and uploads until their verdict, heartbeats at each interval, hellos until they are
answered; a missed departure shows as silence. So events beyond a bound are dropped and counted: no flood fills the
memory, and a flood of one kind leaves room for the others.
"""

import math
import queue
import threading
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any

from dreamfleet.common.protocol.messages import MAX_MESSAGE


@dataclass(frozen=True)
class QueueLimit:
    """How many events of a kind may wait, how many bytes, and how many may arrive a second after a burst."""

    count: int
    size: int  # bytes
    rate: float = math.inf


AT_ONCE, IN_A_SECOND = "too many at once", "too many in a second"  # reasons, which are counted
HELLO_LIMIT = 32  # events after which a waiting hello goes first
QUEUE_LIMITS = {
    "result": QueueLimit(2048, 16 << 20),
    "beat": QueueLimit(2048, 8 << 20),
    "upload": QueueLimit(512, 20 << 20),
    "token": QueueLimit(4096, 1),  # without a payload
    "hello": QueueLimit(256, 4 << 20, 100.0),  # each costs as much as dozens of results, and workers repeat it
    "control": QueueLimit(64, 1 << 20),
    "batch": QueueLimit(1024, 32 << 20),
}


class InboundQueue:
    """A queue with many producer threads and one consumer."""

    def __init__(self, bounds: dict[str, QueueLimit] = QUEUE_LIMITS) -> None:
        self._bounds = bounds
        self._wakeups: queue.SimpleQueue[None] = queue.SimpleQueue()  # one for each event and each wake
        self._first: deque[tuple[str, Any, int]] = deque()
        self._later: deque[tuple[str, Any, int]] = deque()
        self._passed_over = 0
        self._count: Counter[str] = Counter()
        self._size: Counter[str] = Counter()
        self._budget = {kind: (float(bound.count), -math.inf) for kind, bound in bounds.items()}  # how many, as of when
        self._dropped: Counter[str] = Counter()
        self._lock = threading.Lock()

    @property
    def dropped(self) -> Counter[str]:
        """Dropped events, by reason."""
        with self._lock:
            return Counter(self._dropped)

    def put(self, kind: str, event: Any, size: int, now: float) -> bool:
        """Add an event of `size` bytes; whether there was room for it."""
        with self._lock:
            if why := self._drop_reason(kind, size, now):
                self._dropped[why] += 1
                return False
            self._count[kind] += 1
            self._size[kind] += size
            (self._later if kind == "hello" else self._first).append((kind, event, size))
        self._wakeups.put(None)
        return True

    def wake(self) -> None:
        """End a wait without an event. Safe in a signal handler."""
        self._wakeups.put(None)

    def get(self, timeout: float) -> tuple[str, Any]:
        """Take the oldest event; hellos wait for the others, but not forever. `queue.Empty` after `timeout` seconds."""
        self._wakeups.get(timeout=timeout)
        with self._lock:
            hello = self._later and (not self._first or self._passed_over >= HELLO_LIMIT)
            waiting = self._later if hello else self._first
            self._passed_over = 0 if hello else self._passed_over + 1
            if not waiting:
                return "wake", None
            kind, event, size = waiting.popleft()
            self._count[kind] -= 1
            self._size[kind] -= size
        return kind, event

    def _drop_reason(self, kind: str, size: int, now: float) -> str:
        bound = self._bounds[kind]
        if size > MAX_MESSAGE:
            return "oversize"
        if self._count[kind] >= bound.count or self._size[kind] + size > bound.size:
            return AT_ONCE
        return "" if bound.rate == math.inf or self._spend_token(kind, bound, now) else IN_A_SECOND

    def _spend_token(self, kind: str, bound: QueueLimit, now: float) -> bool:
        """Take a token from the kind's bucket, which holds `count` and refills at `rate`; whether there was one."""
        left, then = self._budget[kind]
        left = min(left + bound.rate * max(now - then, 0.0), float(bound.count))
        enough = left >= 1.0
        self._budget[kind] = (left - enough, now)
        return enough
