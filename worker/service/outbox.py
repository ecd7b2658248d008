"""What awaits a verdict of the coordinator: results, and the rollouts that belong to them.

Pure: it takes the time as an argument and returns what to send.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Generic, TypeVar

from dreamfleet.common.protocol.messages import MAX_PART, Result

P = TypeVar("P")
MAX_RESULTS = 64  # results in one message
MAX_ERROR_BYTES = 32 * 1024  # of all error texts in one message; a result without one is far below a kilobyte
MAX_BACKOFF = 8  # the longest pause between two sendings of a result, in multiples of the repeat interval
MAX_BURST = 8  # upload parts that leave together: 320 KB
BURST_INTERVAL = 0.1  # seconds between bursts; heartbeats and results pass between them
MAX_ROUND_DELAY = 8.0  # seconds between two sendings of a whole rollout


@dataclass
class PendingResult:
    """A result, when it was last sent, and how often."""

    result: Result
    sent: float | None = None
    times_sent: int = 0


class Unanswered(Generic[P]):
    """What jobs have left and no verdict has answered, by the jobs' digests, oldest first."""

    def __init__(self, repeat: float) -> None:
        """`repeat` is the first pause until it is sent again, in seconds."""
        self.repeat = repeat
        self._pending: OrderedDict[bytes, P] = OrderedDict()

    def __len__(self) -> int:
        return len(self._pending)

    def acknowledge(self, digests: Iterable[bytes]) -> None:
        """Drop what has a verdict, whatever it is.

        R6: only a verdict ends the repetition, because the coordinator sends it after its journal has the result.
        """
        for digest in digests:
            self._pending.pop(digest, None)


class Outbox(Unanswered[PendingResult]):
    """Results without a verdict. Each is sent at once, and again with growing pauses until its verdict arrives."""

    @property
    def digests(self) -> list[bytes]:
        """Digests of the jobs whose results have no verdict, oldest first."""
        return list(self._pending)

    def add(self, result: Result) -> None:
        """Add the result of a finished job."""
        self._pending[result.digest] = PendingResult(result)

    def resend_all(self) -> None:
        """Make every result due now."""
        for pending in self._pending.values():
            pending.sent, pending.times_sent = None, 0

    def due(self, now: float) -> list[tuple[Result, ...]]:
        """Results to send now, grouped into messages.

        R7: a result or its verdict may be lost, so each result is due again and again until its verdict is here.
        """
        due = [
            each for each in self._pending.values() if each.sent is None or now - each.sent >= self._resend_delay(each)
        ]
        for pending in due:
            pending.sent = now
            pending.times_sent += 1
        return _split_into_messages([pending.result for pending in due])

    def _resend_delay(self, pending: PendingResult) -> float:
        """Seconds until a result is sent again.

        R7: pauses grow, so that repetitions do not fill a slow link. The first two stay short: most losses are single.
        """
        return float(self.repeat * min(2 ** max(pending.times_sent - 2, 0), MAX_BACKOFF))


def _split_into_messages(results: list[Result]) -> list[tuple[Result, ...]]:
    """Group results into messages.

    R13: each message fits the limit, because the number of results and the length of their errors are limited.
    """
    messages: list[list[Result]] = []
    room = 0
    for result in results:
        size = 0 if result.error is None else len(f"{result.error.text}{result.error.cause}".encode(errors="replace"))
        if not messages or len(messages[-1]) == MAX_RESULTS or size > room:
            messages.append([])
            room = MAX_ERROR_BYTES
        messages[-1].append(result)
        room -= size
    return [tuple(each) for each in messages]


@dataclass(frozen=True)
class FilePart:
    """One part of a job's rollout file; `digest` is the job's, `sha256` and `total` (bytes) the file's."""

    digest: bytes
    sha256: bytes
    offset: int
    total: int
    data: bytes


@dataclass
class PendingUpload:
    """A file, how far it was sent in this round, and when the next round begins."""

    sha256: bytes
    data: bytes
    pause: float
    offset: int = 0
    next_round_at: float = 0.0


class UploadQueue(Unanswered[PendingUpload]):
    """Rollout files without a verdict. Each is sent whole at once, and again in rounds with growing pauses.

    R7: a lost part comes with the next round. Bursts and growing pauses keep a slow link free.
    """

    _next_burst_at = 0.0

    def add(self, digest: bytes, data: bytes) -> None:
        """Add the file that a job has left."""
        self._pending[digest] = PendingUpload(hashlib.sha256(data).digest(), data, self.repeat)

    def resend_all(self) -> None:
        """Start each file again: the coordinator that received its parts is gone."""
        for each in self._pending.values():
            each.offset, each.next_round_at, each.pause = 0, 0.0, self.repeat

    def due(self, now: float) -> list[FilePart]:
        """Parts to send now, oldest file first."""
        if now < self._next_burst_at:
            return []
        parts: list[FilePart] = []
        for digest, each in self._pending.items():
            while now >= each.next_round_at and len(parts) < MAX_BURST:
                data = each.data[each.offset : each.offset + MAX_PART]
                parts.append(FilePart(digest, each.sha256, each.offset, len(each.data), data))
                self._advance(each, now)
        if parts:
            self._next_burst_at = now + BURST_INTERVAL
        return parts

    def _advance(self, each: PendingUpload, now: float) -> None:
        each.offset += MAX_PART
        if each.offset >= len(each.data):
            each.offset, each.next_round_at = 0, now + each.pause
            each.pause = min(2 * each.pause, max(MAX_ROUND_DELAY, self.repeat))
