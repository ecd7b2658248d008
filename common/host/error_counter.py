"""Counting and logging errors in message handlers.

No message of a peer may end a loop: a message whose handler raises is dropped, and its sender repeats it if it
matters. Every drop is counted; the log gets the first of a kind, then ever fewer. Pages: protocol.md, decisions.md.
"""

import logging
import threading
import traceback
from collections import Counter

from dreamfleet.common.printable import truncate

MAX_LOGGED_CHARS = 200  # of a message, and of an error


class ErrorCounter:
    """Counts errors by reason; thread-safe."""

    def __init__(self, log: logging.Logger) -> None:
        self._log = log
        self._counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    @property
    def counts(self) -> Counter[str]:
        """The number of errors by reason."""
        with self._lock:
            return Counter(self._counts)

    def record(self, kind: str, error: Exception, event: object) -> None:
        """Count the error that handling `event` raised; log the first, second, fourth, eighth and so on of a reason."""
        reason = f"{kind} that raised {type(error).__name__}"
        with self._lock:
            self._counts[reason] += 1
            count = self._counts[reason]
        if count & (count - 1) == 0:
            frames = traceback.extract_tb(error.__traceback__)
            place = f"{frames[-1].filename}:{frames[-1].lineno}" if frames else "nowhere"
            self._log.error(
                "dropped a %s (%d so far): %s at %s; it was: %s", reason, count, truncate(str(error), MAX_LOGGED_CHARS),
                place, truncate(_describe_event(event), MAX_LOGGED_CHARS),
            )  # fmt: skip


def _describe_event(event: object) -> str:
    """A Zenoh sample or query as its key and the beginning of its payload; anything else as its `repr`."""
    key, payload = getattr(event, "key_expr", None), getattr(event, "payload", None)
    if key is None:
        return repr(event)
    head = b"" if payload is None else payload.to_bytes()[:MAX_LOGGED_CHARS]
    return f"{key} {head!r}"
