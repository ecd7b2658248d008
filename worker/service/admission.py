"""Asking to join a run: hello, and what the answer means.

Whoever reaches the port can answer too. So of several answers a welcome goes before a refusal, and the run that this
worker has joined already before any other; of equals one is taken at random, so that nobody is sure to be believed.
"""

from __future__ import annotations

import json
import random
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, replace

import zenoh

from dreamfleet.common.errors import RefusedError, UsageError
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES, fingerprint
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder, encode_json
from dreamfleet.common.protocol.messages import HelloReply, HelloRequest, Intervals, TaskSpec
from dreamfleet.common.serialization.validation import MAX_TEXT, MalformedError, from_plain
from dreamfleet.common.transport.query import query_all, query_every_responder
from dreamfleet.worker.service.task_allowlist import check_task_allowed

HELLO_TIMEOUT = 2.0
MAX_RUNS_LISTED = 8  # runs by name


@dataclass(frozen=True)
class Admission:
    """A run that this worker has joined, in one life of its coordinator."""

    run: str
    run_uid: str
    incarnation: int
    nonce: str
    spec: TaskSpec
    intervals: Intervals
    packages: tuple[str, ...] = NUMERIC_PACKAGES  # whose versions the run's fingerprint names
    numbering: int = 0  # of the batches that follow
    classes: bool = False  # whether the coordinator knows classes of hosts


def request_admission(
    session: zenoh.Session,
    run: str | None,
    request: HelloRequest,
    inbox: CountingDecoder,
    joined_run_uid: str = "",
    *,
    secured: bool = False,
) -> Admission | None:
    """Say hello to `run`, or to the only live one; `None` if nobody answers, `RefusedError` if the answer is no.

    `joined_run_uid` is the uid of the run that this worker is in.

    A run that asks for a task which the request does not announce is refused in turn: its word imports nothing here.
    In a `secured` fleet it is said under this worker's own name.
    Where the run's fingerprint names other packages than the request's, hello is said again about those.
    """
    reply = _send_hello(session, run, request, inbox, joined_run_uid, secured=secured)
    if reply is not None and not reply.accepted and reply.packages != request.packages:
        named = fingerprint(reply.packages)[:MAX_TEXT]  # the packages that they name are theirs to choose
        about = replace(request, packages=reply.packages, fingerprint=named)
        reply = _send_hello(session, reply.run, about, inbox, joined_run_uid, secured=secured)
    if reply is None:
        return None
    admission = _read_admission(reply)
    check_task_allowed(admission.spec.task, request.tasks)
    return admission


def _send_hello(
    session: zenoh.Session,
    run: str | None,
    request: HelloRequest,
    inbox: CountingDecoder,
    joined_run_uid: str,
    *,
    secured: bool,
) -> HelloReply | None:
    key = keys.secured_hello(run or "*", request.worker) if secured else keys.hello(run or "*")
    replies = []
    for _, payload in query_every_responder(session, [key], HELLO_TIMEOUT, encode_json(request)):
        reply = inbox.decode_json(HelloReply, payload)
        if reply is not None and _is_reply_of(reply, run):
            replies.append(reply)
            if reply.accepted and reply.run_uid == joined_run_uid:  # nobody is to keep it waiting by not answering
                break
    if not replies:
        return None
    if len(names := sorted({reply.run for reply in replies})) > 1:
        raise RefusedError(f"several runs are live: choose one with --run: {', '.join(names[:MAX_RUNS_LISTED])}")
    return max(replies, key=lambda reply: (reply.run_uid == joined_run_uid, reply.accepted, random.random()))  # noqa: S311


def _is_reply_of(reply: HelloReply, run: str | None) -> bool:
    """Whether an answer is of `run`, or of any at all: what else answers is nobody's coordinator."""
    with suppress(UsageError):
        return keys.check_run_name(reply.run) == (run or reply.run)
    return False


def find_run_with_fewest_slots(session: zenoh.Session, excluded: Collection[str] = ()) -> str | None:
    """The live run that works with the fewest slots; of equals the first by name. Those in `excluded` are left out."""
    found = []
    for payload in query_all(session, [keys.status("*")], HELLO_TIMEOUT):
        with suppress(ValueError, KeyError, TypeError):  # what answers need not be of this version
            document = json.loads(payload)
            if document["state"] not in ("ended", "paused") and document["run"] not in excluded:
                found.append((int(document["slots"]), str(document["run"])))
    return min(found)[1] if found else None


def make_request(worker: str, tasks: tuple[str, ...], slots: int) -> HelloRequest:
    """What a worker says of itself."""
    return HelloRequest(
        protocol_min=keys.PROTOCOL_VERSION,
        protocol_max=keys.PROTOCOL_VERSION,
        package=package_version("dreamfleet") or "unknown",
        worker=worker,
        tasks=tasks,
        fingerprint=fingerprint(),
        slots=slots,
    )


def _read_admission(reply: HelloReply) -> Admission:
    if not reply.accepted:
        raise RefusedError(one_line(f"run {reply.run} refused this worker: {reply.why}; {reply.remedy}"))
    try:
        spec, intervals = from_plain(TaskSpec, reply.spec), from_plain(Intervals, reply.intervals)
    except MalformedError as error:
        raise RefusedError(
            f"run {reply.run} (dreamfleet {reply.package}) describes its task in words that this version does not know "
            f"({error}); install dreamfleet {reply.package} here"
        ) from error
    return Admission(
        keys.check_run_name(reply.run), reply.run_uid, reply.incarnation, reply.nonce, spec, intervals, reply.packages,
        reply.numbering, reply.classes,
    )  # fmt: skip
