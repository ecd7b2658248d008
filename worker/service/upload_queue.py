"""Rollouts that are on their way to the coordinator. Pure: a clock in, parts to send out.

The whole is sent again and again, with longer and longer pauses, until the verdict on its job comes: a slow link is
not filled with repetitions, and a part that was lost comes with the next round.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass

from dreamfleet.common.protocol.messages import MAX_PART

MAX_BURST = 8  # parts that leave together: 320 KB
BURST_INTERVAL = 0.1  # seconds between bursts, so that beats and results pass between them
MAX_ROUND_DELAY = 8.0  # seconds between two rounds


@dataclass(frozen=True)
class FilePart:
    """One part of a job's file."""

    digest: bytes
    sha256: bytes
    offset: int
    total: int
    data: bytes


@dataclass
class PendingUpload:
    """A file, how far this round is, and when the next one begins."""

    sha256: bytes
    data: bytes
    pause: float
    offset: int = 0
    next_round_at: float = 0.0


class UploadQueue:
    """Files without a verdict, each sent whole at once and then in rounds."""

    def __init__(self, repeat: float) -> None:
        self._repeat = repeat
        self._sending: OrderedDict[bytes, PendingUpload] = OrderedDict()
        self._next_burst_at = 0.0

    def __len__(self) -> int:
        return len(self._sending)

    def add(self, digest: bytes, data: bytes) -> None:
        """A job has left this file."""
        self._sending[digest] = PendingUpload(hashlib.sha256(data).digest(), data, self._repeat)

    def acknowledge(self, digests: Iterable[bytes]) -> None:
        """Verdicts came, whichever they are."""
        for digest in digests:
            self._sending.pop(digest, None)

    def resend_all(self) -> None:
        """Begin again: the coordinator that had the parts is gone."""
        for each in self._sending.values():
            each.offset, each.next_round_at, each.pause = 0, 0.0, self._repeat

    def due(self, now: float) -> list[FilePart]:
        """Parts to send now, oldest file first."""
        if now < self._next_burst_at:
            return []
        pieces: list[FilePart] = []
        for digest, each in self._sending.items():
            while now >= each.next_round_at and len(pieces) < MAX_BURST:
                data = each.data[each.offset : each.offset + MAX_PART]
                pieces.append(FilePart(digest, each.sha256, each.offset, len(each.data), data))
                self._advance(each, now)
        if pieces:
            self._next_burst_at = now + BURST_INTERVAL
        return pieces

    def _advance(self, each: PendingUpload, now: float) -> None:
        each.offset += MAX_PART
        if each.offset >= len(each.data):
            each.offset, each.next_round_at = 0, now + each.pause
            each.pause = min(2 * each.pause, max(MAX_ROUND_DELAY, self._repeat))
