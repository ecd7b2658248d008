"""What went wrong while one message was handled: counted and told, so that a drop is never silent.

No message of a peer may end a loop. What raises while one is handled costs that message alone, which its sender
repeats where it matters; an endless row of such drops shows in the count and, ever more rarely, in the log.
"""

from __future__ import annotations

import logging
import threading
import traceback
from collections import Counter

from dreamfleet.common.printable import truncate

LONGEST = 200  # characters of a message, and of an error, that are told


class ErrorCounter:
    """Counts by reason; safe in any thread."""

    def __init__(self, log: logging.Logger) -> None:
        self._log = log
        self._counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    @property
    def counts(self) -> Counter[str]:
        """How often, by reason."""
        with self._lock:
            return Counter(self._counts)

    def record(self, kind: str, error: Exception, event: object) -> None:
        """One event of this kind raised: told the first time, the second, the fourth, the eighth."""
        reason = f"{kind} that raised {type(error).__name__}"
        with self._lock:
            self._counts[reason] += 1
            count = self._counts[reason]
        if count & (count - 1) == 0:
            self._log.error(
                "dropped a %s (%d so far): %s at %s; it was: %s", reason, count, truncate(str(error), LONGEST),
                _describe_place(error), truncate(_describe_event(event), LONGEST),
            )  # fmt: skip


def _describe_place(error: Exception) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    return f"{frames[-1].filename}:{frames[-1].lineno}" if frames else "nowhere"


def _describe_event(event: object) -> str:
    """A Zenoh sample or query as its key and the beginning of its payload; anything else as it writes itself."""
    key, payload = getattr(event, "key_expr", None), getattr(event, "payload", None)
    if key is None:
        return repr(event)
    head = b"" if payload is None else payload.to_bytes()[:LONGEST]
    return f"{key} {head!r}"
