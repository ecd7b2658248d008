"""Asking over Zenoh: one query, or several at once, and every reply to them.

Left to itself, Zenoh asks only one of those who answer for a key if that one says that it knows all, and of several
answers to one key tells the last: so whoever reaches the port could answer in a coordinator's place.
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterable, Iterator
from time import monotonic
from typing import Any

import zenoh

GRACE = 2.0  # seconds after which no end of replies is waited for
MAX_WAITING_REPLIES = 65_536  # that wait to be looked at: an answerer without end fills no memory
STOP_CHECK_SECONDS = 0.2  # seconds between looks at whether to stop


def query_every_responder(
    session: zenoh.Session, selectors: Iterable[str], timeout: float, payload: bytes | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[tuple[str, bytes]]:  # fmt: skip
    """Every good reply of everybody who answers, as it comes within `timeout` seconds: whose it is, and its payload.

    Nobody's answer keeps another's away. Whose it is, is the answering session's own word. `payload` is JSON.
    """
    everybody = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}
    for reply in _replies(session, selectors, timeout, payload, stopped, **everybody):
        yield str(reply.replier_id and reply.replier_id.zid), reply.ok.payload.to_bytes()


def query_all(
    session: zenoh.Session, selectors: Iterable[str], timeout: float, payload: bytes | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> list[bytes]:  # fmt: skip
    """The payloads of all good replies that come within `timeout` seconds; those that have come so far if `stopped`.

    `payload` is JSON. All queries are in flight together, and no order of the replies is promised.
    """
    return [reply.ok.payload.to_bytes() for reply in _replies(session, selectors, timeout, payload, stopped)]


def _replies(
    session: zenoh.Session, selectors: Iterable[str], timeout: float, payload: bytes | None,
    stopped: Callable[[], bool], **how: Any,
) -> Iterator[Any]:  # fmt: skip
    """Good replies as they come."""
    replies: queue.SimpleQueue[Any] = queue.SimpleQueue()
    done = object()

    def take(reply: Any) -> None:
        if replies.qsize() < MAX_WAITING_REPLIES:
            replies.put(reply)

    encoding = None if payload is None else "application/json"
    left = 0
    for selector in selectors:
        handler = zenoh.handlers.Callback(take, lambda: replies.put(done), indirect=False)
        session.get(selector, handler, timeout=timeout, payload=payload, encoding=encoding, **how)
        left += 1
    deadline = monotonic() + timeout + GRACE  # Ctrl-C in Zenoh's thread can take an end of replies with it
    while left and not stopped() and monotonic() < deadline:
        try:
            reply = replies.get(timeout=STOP_CHECK_SECONDS)
        except queue.Empty:
            continue
        if reply is done:
            left -= 1
        elif reply.ok is not None:
            yield reply
