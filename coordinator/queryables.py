"""Questions that are answered in Zenoh's own threads: from the latest snapshot, or from a file that nobody writes.

Whatever a question is, it ends neither its thread nor the run: what raises is counted, told, and answered as an error.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import zenoh

from dreamfleet.common import keys
from dreamfleet.common.codec import encode, encoding
from dreamfleet.common.messages import MAX_PART, BundlePart
from dreamfleet.common.mishaps import Mishaps
from dreamfleet.common.status import PARTS
from dreamfleet.coordinator import answers
from dreamfleet.coordinator.served import ServedBundle
from dreamfleet.coordinator.status import Snapshot

Answer = Callable[[zenoh.Query], None]


def answer_status(session: zenoh.Session, name: str, latest: Callable[[], Snapshot], mishaps: Mishaps) -> list[Any]:
    """Declare the parts of the status; each answer reads the latest snapshot and nothing else."""

    def declare(part: str) -> Any:
        def answer(query: zenoh.Query) -> None:
            payload = answers.answer(latest(), part, query.parameters)
            query.reply(keys.status(name, part), payload, encoding="application/json")

        return session.declare_queryable(keys.status(name, part), guarded(answer, mishaps))

    return [declare(part) for part in PARTS]


class BundleServer:
    """Serves one world model in parts."""

    def __init__(self, bundle: ServedBundle, key: str, head: dict[str, Any]) -> None:
        """`head` is what every part says: of which run, in which life, and the bundle's hash."""
        self._bundle = bundle
        self._key = key
        self._head = head

    def declare(self, session: zenoh.Session, mishaps: Mishaps) -> Any:
        """Answer from now on, until what comes back is undeclared."""
        return session.declare_queryable(self._key, guarded(self._answer, mishaps))

    def _answer(self, query: zenoh.Query) -> None:
        asked = query.parameters
        if str(query.key_expr) != self._key:
            query.reply_err(_why("a world model is asked for by its run and hash, without wildcards"))
            return
        try:
            offset, length = int(asked.get("offset") or 0), int(asked.get("length") or MAX_PART)
        except ValueError:
            query.reply_err(_why("offset and length must be whole numbers"))
            return
        offset, total, data = self._bundle.part(offset, length)
        part = BundlePart(**self._head, offset=offset, total=total, data=data)
        query.reply(self._key, encode(part), encoding=encoding(BundlePart))


def guarded(answer: Answer, mishaps: Mishaps) -> Any:
    """A callback that answers, whatever the question: one that raises is answered with an error."""

    def guard(query: zenoh.Query) -> None:
        with query:
            try:
                answer(query)
            except Exception as error:
                mishaps.note("query", error, query)
                with suppress(zenoh.ZError):
                    query.reply_err(_why("this question could not be answered; the coordinator's log says why"))

    return zenoh.handlers.Callback(guard, indirect=False)


def _why(text: str) -> bytes:
    return json.dumps({"why": text}).encode()
