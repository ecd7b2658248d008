"""Results that have no verdict yet. Pure: a clock in, what to send out."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass

from dreamfleet.common.protocol.messages import Result

MAX_RESULTS = 64  # results of a message
MAX_ERROR_BYTES = 32 * 1024  # bytes of a message's errors: without one a result is far below a kilobyte
MAX_BACKOFF = 8  # intervals between two repetitions at most: a verdict on a slow link takes longer than one


@dataclass
class PendingResult:
    """A result, and when it was last sent."""

    result: Result
    sent: float | None = None
    times_sent: int = 0  # that it was sent


class Outbox:
    """Sends each result at once and again after `repeat` seconds, then ever longer pauses, until its verdict comes."""

    def __init__(self, repeat: float) -> None:
        self.repeat = repeat
        self._pending: OrderedDict[bytes, PendingResult] = OrderedDict()

    def __len__(self) -> int:
        return len(self._pending)

    @property
    def digests(self) -> list[bytes]:
        """Of the results without a verdict, oldest first."""
        return list(self._pending)

    def add(self, result: Result) -> None:
        """A job has ended."""
        self._pending[result.digest] = PendingResult(result)

    def acknowledge(self, digests: Iterable[bytes]) -> None:
        """Verdicts came, whichever they are."""
        for digest in digests:
            self._pending.pop(digest, None)

    def resend_all(self) -> None:
        """Send everything again at the next opportunity."""
        for pending in self._pending.values():
            pending.sent, pending.times_sent = None, 0

    def due(self, now: float) -> list[tuple[Result, ...]]:
        """Results to send now, in messages."""
        due = [
            each for each in self._pending.values() if each.sent is None or now - each.sent >= self._resend_delay(each)
        ]
        for pending in due:
            pending.sent = now
            pending.times_sent += 1
        return _split_into_messages([pending.result for pending in due])

    def _resend_delay(self, pending: PendingResult) -> float:
        """Twice at the interval, for what is lost is mostly lost once, then twice as long each time."""
        return float(self.repeat * min(2 ** max(pending.times_sent - 2, 0), MAX_BACKOFF))


def _split_into_messages(results: list[Result]) -> list[tuple[Result, ...]]:
    """The results in as many messages as hold them, however long their errors are."""
    messages: list[list[Result]] = []
    room = 0
    for result in results:
        size = len((result.error or "").encode(errors="replace"))
        if not messages or len(messages[-1]) == MAX_RESULTS or size > room:
            messages.append([])
            room = MAX_ERROR_BYTES
        messages[-1].append(result)
        room -= size
    return [tuple(each) for each in messages]
