"""Queries about batches over Zenoh: submit one in parts, read its scores page by page, cancel it. Thread-safe.

Pages: protocol.md.
"""

import queue
from collections.abc import Callable, Sequence
from time import monotonic
from typing import Any

import zenoh

from dreamfleet.common.client.client import QUERY_TIMEOUT, Client, read_answer
from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.batches import (
    FINAL,
    BatchError,
    BatchEvent,
    BatchHeader,
    BatchLine,
    BatchReply,
    check_batch_id,
)
from dreamfleet.common.protocol.codec import decode_json
from dreamfleet.common.protocol.messages import MAX_PART
from dreamfleet.common.schema.validation import MalformedError
from dreamfleet.common.transport.query import GRACE

LEAST_RATE = 1e6  # bytes of a batch that a busy coordinator stores a second
PARTS_AT_ONCE = 32  # of a body: what a coordinator's queue holds, many times over


class BatchClient:
    """Queries the coordinator of any run through a `client`.

    `ConnectionFailedError` if no coordinator answers, `BatchError` if it refuses, `AccessError` if the join file ended.
    """

    def __init__(self, client: Client) -> None:
        self._client, self._session = client, client.session

    def submit(self, run: str, header: BatchHeader, body: bytes) -> BatchReply:
        """Send a batch; the reply says that it is durable. Sending it again changes nothing."""
        offsets = range(0, header.total, MAX_PART)
        last: BatchReply | None = None
        for start in range(0, len(offsets), PARTS_AT_ONCE):
            some = offsets[start : start + PARTS_AT_ONCE]
            sent = [(f"{header.parameters};offset={each}", body[each : each + MAX_PART]) for each in some]
            for reply in self._query(run, "submit", sent, QUERY_TIMEOUT + header.total / LEAST_RATE):
                last = reply if last is None or last.state == "uploading" else last
            if last is not None and last.state != "uploading":
                return last
        raise ConnectionFailedError(f"a part of batch {header.id} did not reach the coordinator of run {run!r}")

    def read(self, run: str, batch_id: str, offset: int = 0) -> BatchReply:
        """The state of a batch, and a page of its scores from candidate `offset` on."""
        return self._query(run, "read", [(f"id={check_batch_id(batch_id)};offset={offset}", None)])[0]

    def list_batches(self, run: str) -> tuple[BatchLine, ...]:
        """The open batches in their order, then finished ones, the last first; 512 at most (batch_records.py)."""
        return self._query(run, "list", [("", None)])[0].batches

    def cancel(self, run: str, batch_id: str) -> BatchReply:
        """Cancel a batch; a finished one stays as it is."""
        return self._query(run, "cancel", [(f"id={check_batch_id(batch_id)}", None)])[0]

    def on_change(self, run: str, changed: Callable[[BatchEvent], None]) -> Any:
        """Call `changed`, in a thread of Zenoh's, for each event about a batch until the result is undeclared."""

        def receive(sample: zenoh.Sample) -> None:
            try:
                event = decode_json(BatchEvent, sample.payload.to_bytes())
            except MalformedError:
                return  # anybody may publish at an open port
            changed(event)

        handler = zenoh.handlers.Callback(receive, indirect=False)
        return self._session.declare_subscriber(keys.event_batch(run), handler)

    def _query(
        self, run: str, verb: str, sent: Sequence[tuple[str, bytes | None]], timeout: float = QUERY_TIMEOUT
    ) -> list[BatchReply]:
        """The reply to each of these queries, which are sent at once; the first refusal is raised."""
        self._client.check_join_file()
        replies: queue.SimpleQueue[Any] = queue.SimpleQueue()
        key = keys.batch(keys.check_run_name(run), verb)
        for parameters, payload in sent:
            handler = zenoh.handlers.Callback(replies.put, lambda: replies.put(None), indirect=False)
            self._session.get(f"{key}?{parameters}", handler, timeout=timeout, payload=payload)
        found: list[BatchReply] = []
        left, deadline = len(sent), monotonic() + timeout + GRACE
        while left:
            try:
                reply = replies.get(timeout=max(deadline - monotonic(), 0.0))
            except queue.Empty:  # Ctrl-C in Zenoh's thread can lose the end signal
                break
            if reply is None:
                left -= 1
            elif reply.ok is not None:
                found.append(read_answer(BatchReply, run, reply.ok.payload.to_bytes()))
        if refused := next((each for each in found if each.refused), None):
            raise BatchError(refused.refused, refused.why)
        is_stored = any(each.state not in ("", "uploading") for each in found)
        if not found or (len(found) < len(sent) and not is_stored):
            raise ConnectionFailedError(
                f"no coordinator of run {run!r} answers: it is not running, or the join file gives no right to submit; "
                f"`dreamfleet coordinator --resume {run} --runs-dir FOLDER` continues a run that was stopped or killed"
            )
        return found


def is_final(reply: BatchReply) -> bool:
    """Whether the batch will have no further scores."""
    return reply.state in FINAL
