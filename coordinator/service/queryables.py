"""Questions that are answered in Zenoh's own threads: from the latest snapshot, or from a file that nobody writes.

Whatever a question is, it ends neither its thread nor the run: what raises is counted, told, and answered as an error.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import zenoh

from dreamfleet.common.host.error_counter import ErrorCounter
from dreamfleet.common.monitoring.status import PARTS
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode, encoding
from dreamfleet.common.protocol.messages import MAX_PART, BundlePart
from dreamfleet.coordinator.service import status_json
from dreamfleet.coordinator.service.status import Snapshot
from dreamfleet.coordinator.storage.served_bundle import ServedBundle

Answer = Callable[[zenoh.Query], None]


def declare_status(
    session: zenoh.Session, name: str, latest: Callable[[], Snapshot], error_counter: ErrorCounter
) -> list[Any]:
    """Declare the parts of the status; each answer reads the latest snapshot and nothing else."""

    def declare(part: str) -> Any:
        def answer(query: zenoh.Query) -> None:
            payload = status_json.answer(latest(), part, query.parameters)
            query.reply(keys.status(name, part), payload, encoding="application/json")

        return session.declare_queryable(keys.status(name, part), guarded_callback(answer, error_counter))

    return [declare(part) for part in PARTS]


class BundleServer:
    """Serves one world model in parts."""

    def __init__(self, bundle: ServedBundle, key: str, head: dict[str, Any]) -> None:
        """`head` is what every part says: of which run, in which life, and the bundle's hash."""
        self._bundle = bundle
        self._key = key
        self._head = head

    def declare(self, session: zenoh.Session, error_counter: ErrorCounter) -> Any:
        """Answer from now on, until what comes back is undeclared."""
        return session.declare_queryable(self._key, guarded_callback(self._answer, error_counter))

    def _answer(self, query: zenoh.Query) -> None:
        asked = query.parameters
        if str(query.key_expr) != self._key:
            query.reply_err(_error_body("a world model is asked for by its run and hash, without wildcards"))
            return
        try:
            offset, length = int(asked.get("offset") or 0), int(asked.get("length") or MAX_PART)
        except ValueError:
            query.reply_err(_error_body("offset and length must be whole numbers"))
            return
        offset, total, data = self._bundle.read_part(offset, length)
        part = BundlePart(**self._head, offset=offset, total=total, data=data)
        query.reply(self._key, encode(part), encoding=encoding(BundlePart))


def guarded_callback(answer: Answer, error_counter: ErrorCounter) -> Any:
    """A callback that answers, whatever the question: one that raises is answered with an error."""

    def guard(query: zenoh.Query) -> None:
        with query:
            try:
                answer(query)
            except Exception as error:
                error_counter.record("query", error, query)
                with suppress(zenoh.ZError):
                    query.reply_err(_error_body("this question could not be answered; the coordinator's log says why"))

    return zenoh.handlers.Callback(guard, indirect=False)


def _error_body(text: str) -> bytes:
    return json.dumps({"why": text}).encode()
