"""Asking over Zenoh: one query, or several at once, and every reply to them."""

from __future__ import annotations

import queue
from collections.abc import Callable, Iterable
from time import monotonic
from typing import Any

import zenoh

GRACE = 2.0  # seconds after which no end of replies is waited for
MOST_REPLIES = 65_536  # that wait to be looked at: an answerer without end fills no memory
LOOK = 0.2  # seconds between looks at whether to stop


def ask_all(
    session: zenoh.Session, selectors: Iterable[str], timeout: float, payload: bytes | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> list[bytes]:  # fmt: skip
    """The payloads of all good replies that come within `timeout` seconds; those that have come so far if `stopped`.

    `payload` is JSON. All queries are in flight together, and no order of the replies is promised.
    """
    replies: queue.SimpleQueue[Any] = queue.SimpleQueue()
    done = object()

    def take(reply: Any) -> None:
        if replies.qsize() < MOST_REPLIES:
            replies.put(reply)

    encoding = None if payload is None else "application/json"
    left = 0
    for selector in selectors:
        handler = zenoh.handlers.Callback(take, lambda: replies.put(done), indirect=False)
        session.get(selector, handler, timeout=timeout, payload=payload, encoding=encoding)
        left += 1
    payloads: list[bytes] = []
    deadline = monotonic() + timeout + GRACE  # Ctrl-C in Zenoh's thread can take an end of replies with it
    while left and not stopped() and monotonic() < deadline:
        try:
            reply = replies.get(timeout=LOOK)
        except queue.Empty:
            continue
        if reply is done:
            left -= 1
        elif reply.ok is not None:
            payloads.append(reply.ok.payload.to_bytes())
    return payloads
