"""Results that have no verdict yet. Pure: a clock in, what to send out."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass

from dreamfleet.common.messages import Result

BATCH = 64  # results of a message
ROOM = 32 * 1024  # bytes of a message's errors: without one a result is far below a kilobyte
LONGEST = 8  # intervals between two repetitions at most: a verdict on a slow link takes longer than one


@dataclass
class Waiting:
    """A result, and when it was last sent."""

    result: Result
    sent: float | None = None
    times: int = 0  # that it was sent


class Outbox:
    """Sends each result at once and again after `repeat` seconds, then ever longer pauses, until its verdict comes."""

    def __init__(self, repeat: float) -> None:
        self.repeat = repeat
        self._waiting: OrderedDict[bytes, Waiting] = OrderedDict()

    def __len__(self) -> int:
        return len(self._waiting)

    @property
    def digests(self) -> list[bytes]:
        """Of the results without a verdict, oldest first."""
        return list(self._waiting)

    def add(self, result: Result) -> None:
        """A job has ended."""
        self._waiting[result.digest] = Waiting(result)

    def settle(self, digests: Iterable[bytes]) -> None:
        """Verdicts came, whichever they are."""
        for digest in digests:
            self._waiting.pop(digest, None)

    def resend_all(self) -> None:
        """Send everything again at the next opportunity."""
        for waiting in self._waiting.values():
            waiting.sent, waiting.times = None, 0

    def due(self, now: float) -> list[tuple[Result, ...]]:
        """Results to send now, in messages."""
        due = [each for each in self._waiting.values() if each.sent is None or now - each.sent >= self._pause(each)]
        for waiting in due:
            waiting.sent = now
            waiting.times += 1
        return _messages([waiting.result for waiting in due])

    def _pause(self, waiting: Waiting) -> float:
        """Twice at the interval, for what is lost is mostly lost once, then twice as long each time."""
        return float(self.repeat * min(2 ** max(waiting.times - 2, 0), LONGEST))


def _messages(results: list[Result]) -> list[tuple[Result, ...]]:
    """The results in as many messages as hold them, however long their errors are."""
    messages: list[list[Result]] = []
    room = 0
    for result in results:
        size = len((result.error or "").encode(errors="replace"))
        if not messages or len(messages[-1]) == BATCH or size > room:
            messages.append([])
            room = ROOM
        messages[-1].append(result)
        room -= size
    return [tuple(each) for each in messages]
