"""Queries about batches, answered by the service's thread once the journal has committed what they changed."""

from collections.abc import Iterable

import zenoh

from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.batches import BatchReply
from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.coordinator.run.batches import Batches

PROGRESS_INTERVAL = 0.1  # seconds between two events about the open batch


class BatchQueries:  # docs/how-to/ask-tell.md
    """Holds the replies of `batches` back until `send`."""

    def __init__(self, batches: Batches, name: str) -> None:
        self._batches = batches
        self._name = name
        self._replies: list[tuple[zenoh.Query, BatchReply]] = []
        self._progress_at = 0.0

    @property
    def has_waiting(self) -> bool:
        """Whether a reply waits for a commit."""
        return bool(self._replies)

    def handle(self, query: zenoh.Query, now: float) -> None:
        """Do what a query says; its reply waits, unless it says only what is durable."""
        key = str(query.key_expr)
        verb = key.rsplit("/", 1)[-1]
        payload = query.payload.to_bytes() if query.payload is not None else b""
        named = verb if key == keys.batch(self._name, verb) else key
        reply = self._batches.answer(named, query.parameters.get, payload, now)
        if self._batches.run.state.stalled:
            _reply(query, reply)
        else:
            self._replies.append((query, reply))

    def send(self, session: zenoh.Session, closed: Iterable[int], now: float, *, durable: bool) -> None:
        """Reply, and publish what changed, if the journal is `durable`; else reply what the journal has.

        R29: nobody hears of a batch or a score that is not on disk, so no crash takes back what an answer said.
        """
        self._batches.tick(now)
        replies, self._replies = self._replies, []
        for query, reply in replies:
            if durable:
                _reply(query, reply)
            else:
                self.handle(query, now)
        if durable:
            progress = now - self._progress_at >= PROGRESS_INTERVAL
            self._progress_at = now if progress else self._progress_at
            for event in self._batches.take_events(closed, progress=progress):
                session.put(keys.event_batch(self._name), encode_json(event), encoding="application/json")


def _reply(query: zenoh.Query, reply: BatchReply) -> None:
    with query:
        query.reply(query.key_expr, encode_json(reply), encoding="application/json")
