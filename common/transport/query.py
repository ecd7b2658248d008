"""Zenoh queries that collect replies: the last one for each key, or every responder's."""

import queue
from collections.abc import Callable, Iterable, Iterator
from time import monotonic
from typing import Any

import zenoh

GRACE = 2.0  # seconds after the timeout to wait for Zenoh's end-of-replies signal
MAX_WAITING_REPLIES = 65_536  # further ones are dropped, so that a flood of replies cannot fill the memory
STOP_CHECK_SECONDS = 0.2


def query_every_responder(
    session: zenoh.Session, selectors: Iterable[str], timeout: float, payload: bytes | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[str, bytes]]:  # fmt: skip
    """Yield every good reply that comes within `timeout` seconds: the responder's Zenoh ID and its payload.

    By default Zenoh may ask only one responder, and keeps the last of several replies for a key. Then anyone who
    reaches the port could answer in a coordinator's place. Here no reply replaces another one. The ID is as the
    responder claims. The query's `payload` is JSON.
    """
    all_replies = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}
    for reply in _replies(session, selectors, timeout, payload, stopped, **all_replies):
        yield str(reply.replier_id and reply.replier_id.zid), reply.ok.payload.to_bytes()


def query_all(session: zenoh.Session, selectors: Iterable[str], timeout: float) -> list[bytes]:
    """The payloads of the good replies to concurrent queries within `timeout` seconds: one for each key, unordered."""
    return [reply.ok.payload.to_bytes() for reply in _replies(session, selectors, timeout)]


def _replies(
    session: zenoh.Session, selectors: Iterable[str], timeout: float, payload: bytes | None = None,
    stopped: Callable[[], bool] = lambda: False, **options: Any,
) -> Iterator[Any]:  # fmt: skip
    """Yield good replies as they arrive."""
    replies: queue.SimpleQueue[Any] = queue.SimpleQueue()
    done = object()

    def take(reply: Any) -> None:
        if replies.qsize() < MAX_WAITING_REPLIES:
            replies.put(reply)

    encoding = None if payload is None else "application/json"
    left = 0
    for selector in selectors:
        handler = zenoh.handlers.Callback(take, lambda: replies.put(done), indirect=False)
        session.get(selector, handler, timeout=timeout, payload=payload, encoding=encoding, **options)
        left += 1
    deadline = monotonic() + timeout + GRACE  # Ctrl-C in Zenoh's thread can lose the end signal
    while left and not stopped() and monotonic() < deadline:
        try:
            reply = replies.get(timeout=STOP_CHECK_SECONDS)
        except queue.Empty:
            continue
        if reply is done:
            left -= 1
        elif reply.ok is not None:
            yield reply
