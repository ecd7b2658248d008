"""Asking a run over Zenoh how it is: status, its parts, and watching generations end. Read-only but for `control`."""

from __future__ import annotations

import json
import queue
from collections.abc import Iterator
from types import TracebackType
from typing import Any

import zenoh

from dreamfleet.common import keys
from dreamfleet.common.codec import MalformedError, decode_json
from dreamfleet.common.errors import ConnectionFailedError, RefusedError, UsageError
from dreamfleet.common.messages import ControlReply
from dreamfleet.common.session import Network, open_session

QUERY_TIMEOUT = 3.0


class Client:
    """A connection to the router of one or more runs; use it in a `with`.

    >>> with Client(("tcp/127.0.0.1:7447",)) as client:  # doctest: +SKIP
    ...     print(client.status("my-run")["state"])
    """

    def __init__(self, connect: tuple[str, ...]) -> None:
        self._where = ", ".join(connect)
        self._session = open_session(Network(connect=connect))

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._session.close()  # type: ignore[no-untyped-call]

    def runs(self) -> list[str]:
        """Names of the live runs."""
        return sorted(document["run"] for document in self._ask(keys.status("*")))

    def status(self, run: str | None = None, part: str = "") -> dict[str, Any]:
        """The status document of `run`, or of the only live run; `part` as in `keys.status`."""
        documents = self._ask(keys.status(keys.check_run_name(run) if run else "*", part))
        if len(documents) > 1:
            names = ", ".join(sorted(document["run"] for document in documents))
            raise UsageError(f"several runs are live: name one with --run: {names}")
        if not documents:
            which = f"run {run!r}" if run else "any run"
            raise ConnectionFailedError(
                f"no coordinator of {which} answers through {self._where}: it is not running, or you lack the "
                "right to ask"
            )
        return documents[0]

    def pages(self, part: str, run: str) -> Iterator[dict[str, Any]]:
        """All rows of a paged part: `workers` or `history`."""
        offset = 0
        while True:
            document = self._ask(f"{keys.status(run, part)}?offset={offset}")[0]
            yield from document[part]
            offset += len(document[part])
            if offset >= document["total"] or not document[part]:
                return

    def control(self, run: str, verb: str) -> None:
        """Ask the coordinator to `pause`, `resume`, `drain` or `stop`; `RefusedError` says why it does not."""
        for reply in self._session.get(keys.control(keys.check_run_name(run), verb), timeout=QUERY_TIMEOUT):
            if reply.ok is not None:
                answer = decode_json(ControlReply, reply.ok.payload.to_bytes())
                if not answer.accepted:
                    raise RefusedError(answer.why)
                return
        raise ConnectionFailedError(
            f"no coordinator of run {run!r} answers through {self._where}: it is not running, or you lack the right "
            "to ask"
        )

    def _ask(self, selector: str) -> list[dict[str, Any]]:
        replies: queue.SimpleQueue[Any] = queue.SimpleQueue()
        done = object()
        handler = zenoh.handlers.Callback(replies.put, lambda: replies.put(done), indirect=False)
        self._session.get(selector, handler, timeout=QUERY_TIMEOUT)
        documents = []
        while (reply := replies.get()) is not done:
            if reply.ok is not None:
                try:
                    documents.append(json.loads(reply.ok.payload.to_bytes()))
                except ValueError as error:
                    raise MalformedError("not JSON") from error
        return documents
