"""Joining a run: the hello request and its answer. Pages: threats.md, share-a-fleet.md."""

import json
import math
import random
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import zenoh

from dreamfleet.common.errors import RefusedError, UsageError
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES, fingerprint
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder, encode_json
from dreamfleet.common.protocol.messages import MIN_SHARE, HelloReply, HelloRequest, Intervals, TaskSpec
from dreamfleet.common.schema.validation import MAX_TEXT, MalformedError, from_plain
from dreamfleet.common.security.host_key import host_token
from dreamfleet.common.transport.query import query_all, query_every_responder
from dreamfleet.worker.tasks.registry import check_task_allowed

HELLO_TIMEOUT = 2.0
MAX_RUNS_LISTED = 8  # run names in an error message


@dataclass(frozen=True)
class Admission:
    """A run that this worker has joined, in one incarnation of its coordinator."""

    run: str
    run_uid: str
    incarnation: int
    nonce: str
    spec: TaskSpec
    intervals: Intervals
    packages: tuple[str, ...] = NUMERIC_PACKAGES  # the run's fingerprint consists of their versions
    numbering: int = 0  # R12: of the batches that follow; older ones cannot pass for current ones
    share: float = 1.0  # of the worker's slots, relative to its other runs' shares
    package: str = ""  # the coordinator's version


@dataclass(frozen=True)
class CoordinatorLink:
    """How this worker reaches coordinators: its session, its hello and its decoder."""

    session: zenoh.Session
    hello: HelloRequest
    inbox: CountingDecoder
    secured: bool = False  # whether the fleet has join files; hello then goes to this worker's own key
    torch_device: str = ""  # that the fingerprint covers

    @property
    def identity(self) -> str:
        """The worker's name and process."""
        return self.hello.worker

    def request_admission(self, run: str | None, host_class: str = "", joined_run_uid: str = "") -> Admission | None:
        """Say hello to `run`, or to the only live run; `None` if nobody answers, `RefusedError` if that is refused.

        `joined_run_uid` is the uid of the run that this worker has joined, if any. If the run's fingerprint covers
        other packages than the request's, hello is sent again with a fingerprint of those. A run whose task the hello
        does not announce is refused, so that an answer never makes this worker import code.
        """
        request = replace(self.hello, host_class=host_class)
        reply = self._send_hello(run, request, joined_run_uid)
        if reply is not None and not reply.accepted and reply.packages != request.packages:
            named = fingerprint(reply.packages, self.torch_device)[:MAX_TEXT]  # the coordinator chooses how many
            about = replace(request, packages=reply.packages, fingerprint=named)
            reply = self._send_hello(reply.run, about, joined_run_uid)
        if reply is None:
            return None
        admission = _read_admission(reply)
        check_task_allowed(admission.spec.task, request.tasks)
        return admission

    def _send_hello(self, run: str | None, request: HelloRequest, joined_run_uid: str) -> HelloReply | None:
        """The answer to one hello request.

        R23: a single refusal decides nothing, because anybody on the network can answer. The joined run comes first,
        then a welcome, then a refusal. Of equal answers one is drawn at random, so that no unknown sender always wins.
        """
        key = keys.secured_hello(run or "*", request.worker) if self.secured else keys.hello(run or "*")
        request, replies = replace(request, host_token=host_token(request.worker)), []
        for _, payload in query_every_responder(self.session, [key], HELLO_TIMEOUT, encode_json(request)):
            reply = self.inbox.decode_json(HelloReply, payload)
            if reply is not None and _is_reply_of(reply, run):
                replies.append(reply)
                if reply.accepted and reply.run_uid == joined_run_uid:  # no need to wait for others
                    break
        if not replies:
            return None
        if len(names := sorted({reply.run for reply in replies})) > 1:
            listed = ", ".join(names[:MAX_RUNS_LISTED])
            raise RefusedError(f"several runs are live, {listed}; choose one", ("--run", names[0]))
        return max(replies, key=lambda reply: (reply.run_uid == joined_run_uid, reply.accepted, random.random()))  # noqa: S311


def _is_reply_of(reply: HelloReply, run: str | None) -> bool:
    """Whether an answer comes from `run`, or, if that is `None`, from a run with a valid name."""
    with suppress(UsageError):
        return keys.check_run_name(reply.run) == (run or reply.run)
    return False


def find_run_with_fewest_slots(session: zenoh.Session, excluded: Collection[str] = ()) -> str | None:
    """The live run with the fewest slots by its share, without those in `excluded`; of equals the first by name."""
    found = []
    for document in _live_statuses(session):
        with suppress(ValueError, KeyError, TypeError, OverflowError, UsageError):  # anybody may answer anything
            name = keys.check_run_name(document["run"])
            if document["state"] not in ("ended", "paused") and name not in excluded:
                slots, share = int(document["slots"]), float(document.get("share", 1.0))
                if math.isfinite(share):
                    found.append((slots / max(share, MIN_SHARE), name))
    return min(found)[1] if found else None


def find_names_of_run(session: zenoh.Session, uid: str) -> list[str]:
    """The names under which the run of this `uid` is live now, sorted: more than one where a copy is served too."""
    return sorted(name for name, own in _live_names(session) if own == uid)


def find_live_names(session: zenoh.Session) -> list[str]:
    """The names of all live runs, sorted."""
    return sorted({name for name, _ in _live_names(session)})


def _live_names(session: zenoh.Session) -> Iterator[tuple[str, Any]]:
    for document in _live_statuses(session):
        with suppress(KeyError, TypeError, UsageError):
            yield keys.check_run_name(document["run"]), document["run_uid"]


def _live_statuses(session: zenoh.Session) -> Iterator[Any]:
    """What answers to a query for all runs' statuses: JSON that nobody has checked."""
    for payload in query_all(session, [keys.status("*")], HELLO_TIMEOUT):
        with suppress(ValueError, RecursionError):
            yield json.loads(payload)


def make_request(worker: str, tasks: tuple[str, ...], slots: int, *, torch_device: str = "") -> HelloRequest:
    """The hello request of a worker."""
    return HelloRequest(
        protocol_min=keys.PROTOCOL_VERSION,
        protocol_max=keys.PROTOCOL_VERSION,
        package=package_version("dreamfleet") or "unknown",
        worker=worker,
        tasks=tasks,
        fingerprint=fingerprint(torch_device=torch_device),
        slots=slots,
    )


def _read_admission(reply: HelloReply) -> Admission:
    if not reply.accepted:
        own = package_version("dreamfleet")
        versions = "" if reply.package == own else f" (dreamfleet {reply.package}, here is {own})"
        why = one_line(f"run {reply.run}{versions} refused this worker: {reply.why}; {reply.remedy}")
        raise RefusedError(why, ("--task", reply.unannounced_task) if reply.unannounced_task else None)
    try:
        spec, intervals = from_plain(TaskSpec, reply.spec), from_plain(Intervals, reply.intervals)
    except MalformedError as error:
        raise RefusedError(
            f"run {reply.run} (dreamfleet {reply.package}) describes its task in a form that this version does not "
            f"know ({error}); install dreamfleet {reply.package} here"
        ) from error
    return Admission(
        keys.check_run_name(reply.run), reply.run_uid, reply.incarnation, reply.nonce, spec, intervals, reply.packages,
        reply.numbering, reply.share, reply.package,
    )  # fmt: skip
