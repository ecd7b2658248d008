"""Queries that need no turn of the run: status from the latest snapshot, the world model from an immutable file.

No query ends a thread or the run: an exception is counted, logged and answered as an error. Answers have threads of
their own, since Zenoh receives all messages of a link in one thread.
"""

import json
import queue
from collections.abc import Callable
from contextlib import suppress
from threading import Thread
from typing import Any

import zenoh

from dreamfleet.common.client.status import PARTS
from dreamfleet.common.host.error_counter import ErrorCounter
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode, encoding
from dreamfleet.common.protocol.messages import MAX_PART, BundlePart
from dreamfleet.coordinator.service.snapshot import Snapshot
from dreamfleet.coordinator.service.status import encode_part
from dreamfleet.coordinator.storage.served_bundle import ServedBundle

Answer = Callable[[zenoh.Query], None]
MOST_WAITING = 64  # queries of a part; further ones are dropped without an answer (R26)


def declare_status(
    session: zenoh.Session, name: str, latest: Callable[[], Snapshot], error_counter: ErrorCounter
) -> list[Any]:
    """Declare a queryable for each part of the status; an answer reads only the `latest` snapshot."""

    def declare(part: str) -> Any:
        encoded, payloads = latest(), dict[str, bytes]()  # of one snapshot: it takes long, and many may ask alike

        def answer(query: zenoh.Query) -> None:
            nonlocal encoded, payloads
            if (snapshot := latest()) is not encoded:
                encoded, payloads = snapshot, {}
            if (wanted := part and str(query.parameters)) not in payloads:  # the status itself has none
                payloads[wanted] = encode_part(snapshot, part, query.parameters.get)
            query.reply(keys.status(name, part), payloads[wanted], encoding="application/json")

        return session.declare_queryable(keys.status(name, part), _in_own_thread(answer, error_counter))

    return [declare(part) for part in PARTS]


def declare_bundle(
    session: zenoh.Session, key: str, bundle: ServedBundle, head: dict[str, Any], error_counter: ErrorCounter
) -> Any:
    """Declare a queryable that serves a run's world model in parts.

    `head` holds the fields of every part: the run, the incarnation and the bundle's hash.
    """

    def answer(query: zenoh.Query) -> None:
        parameters = query.parameters
        if str(query.key_expr) != key:
            query.reply_err(_error_body("name a world model by its run and hash, without wildcards"))
            return
        try:
            offset, length = int(parameters.get("offset") or 0), int(parameters.get("length") or MAX_PART)
        except ValueError:
            query.reply_err(_error_body("offset and length must be whole numbers"))
            return
        offset, total, data = bundle.read_part(offset, length)
        part = BundlePart(**head, offset=offset, total=total, data=data)
        query.reply(key, encode(part), encoding=encoding(BundlePart))

    return session.declare_queryable(key, _in_own_thread(answer, error_counter))


def _in_own_thread(answer: Answer, error_counter: ErrorCounter) -> Any:
    """A Zenoh callback for `answer`, which runs in a thread until the queryable ends; if it raises, it is an error."""
    waiting: queue.SimpleQueue[zenoh.Query | None] = queue.SimpleQueue()

    def enqueue(query: zenoh.Query) -> None:
        if waiting.qsize() < MOST_WAITING:
            waiting.put(query)
        else:
            query.drop()  # type: ignore[no-untyped-call]

    def run() -> None:
        while (query := waiting.get()) is not None:
            with query, suppress(zenoh.ZError):  # the session has been closed
                try:
                    answer(query)
                except zenoh.ZError:
                    raise
                except Exception as error:
                    error_counter.record("query", error, query)
                    query.reply_err(_error_body("this query could not be answered; the coordinator's log says why"))

    Thread(target=run, name="answers", daemon=True).start()
    return zenoh.handlers.Callback(enqueue, lambda: waiting.put(None), indirect=False)


def _error_body(text: str) -> bytes:
    return json.dumps({"why": text}).encode()
