"""The coordinator on Zenoh: one owner thread, one queue; callbacks only enqueue, or answer from a ready snapshot.

Life: startup (session, lock on the name, queryables) -> loop (events, advance, commit, dispatch) -> shutdown.
"""

from __future__ import annotations

import logging
import math
import queue
import secrets
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from itertools import islice
from time import monotonic
from typing import Any

import zenoh

from dreamfleet.common.errors import DreamfleetError, RefusedError
from dreamfleet.common.host.error_counter import ErrorCounter
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder, encode, encode_json, encoding
from dreamfleet.common.protocol.messages import (
    GenerationEvent,
    Heartbeat,
    HelloRequest,
    Intervals,
    JobBatch,
    Message,
    ResultBatch,
    UploadPart,
)
from dreamfleet.common.security.certificate_ledger import RevocationWatcher
from dreamfleet.common.security.credentials import EXPIRY_WARNING, describe_time_left, worker_seat_identity
from dreamfleet.common.serialization.validation import MalformedError
from dreamfleet.common.transport.network import is_loopback
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.coordinator.dispatch.packing import BatchContent, OutgoingBatch
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.service import status_json
from dreamfleet.coordinator.service.inbound_queue import InboundQueue
from dreamfleet.coordinator.service.log_messages import summary, worker_command
from dreamfleet.coordinator.service.metrics_server import serve_metrics
from dreamfleet.coordinator.service.name_lock import NameLock
from dreamfleet.coordinator.service.queryables import BundleServer, declare_status
from dreamfleet.coordinator.service.reply_messages import control_reply, control_verb, hello_reply, malformed_hello
from dreamfleet.coordinator.service.status import Snapshot, full_status, mark_left, take_snapshot
from dreamfleet.coordinator.storage.file_watch import FileWatch
from dreamfleet.coordinator.storage.served_bundle import ServedBundle

log = logging.getLogger(__name__)
TICK = 0.05  # seconds: the longest that a loss waits to be acted upon
MOST_EVENTS_PER_COMMIT = 256  # events that share one commit at most
LINGER = 0.005  # seconds that a commit waits for more to share it
SNAPSHOT_INTERVAL = 0.2
SUMMARY_INTERVAL = 60.0  # seconds from one line about the run to the next
DISBAND_TIMEOUT = 10.0  # seconds that workers may take to leave a run that ends with them
DAY = 86_400.0  # seconds from one warning of the join file's end to the next
NO_WORKER_SECONDS = 5.0  # seconds without a worker after which the log says so
_WORKER_MESSAGES: dict[str, type[Message]] = {"result": ResultBatch, "beat": Heartbeat, "upload": UploadPart}


class Service:
    """Serves one run until it ends or `stop` is called."""

    def __init__(
        self, name: str, network: Network, intervals: Intervals, file_watch: FileWatch, bundle: ServedBundle | None,
        metrics_port: str = "", revocations: RevocationWatcher | None = None,
    ) -> None:  # fmt: skip
        self._name = name
        self._file_watch = file_watch
        self._bundle = bundle
        self._network = network
        self._secured = network.credentials is not None
        self._revocations = revocations
        self._metrics_port = metrics_port
        self._intervals = intervals
        self._nonce = secrets.token_hex(8)
        self._events = InboundQueue()
        self._inbox = CountingDecoder()
        self._error_counter = ErrorCounter(log)
        self._stopping = self._draining = False
        self._disbanding_since: float | None = None  # every batch then says `leave`
        self._leave_sent_at = -math.inf
        self._evaluations_logged = 0
        self._expiry_at = 0.0

    def stop(self) -> None:
        """End the loop soon; the run can be continued. Safe in a signal handler."""
        self._stopping = True
        self._events.wake()

    def serve(self, run_maker: Callable[[], Run], on_ready: Callable[[Run], None] = lambda _run: None) -> Run:
        """Claim the name on the wire, make the run, serve it; the run as it was when the service left."""
        with ExitStack() as last, open_session(self._network) as session, ExitStack() as stack:
            self._name_lock = NameLock(session, self._name, self._nonce, stack)
            self._name_lock.acquire()
            self._run = run_maker()
            self._name_lock.announce(self._run.uid, self._run.incarnation)
            self._worker_protocol = self._run.worker_protocol
            self._started = self._no_worker_since = self._summary_logged_at = monotonic()
            self._snapshot = self._take_snapshot()
            last.enter_context(serve_metrics(self._metrics_port, lambda: self._snapshot, lambda: self._stopping))
            declared = self._declare(session)
            begun = {"run": self._name, "run_uid": self._run.uid, "incarnation": self._run.incarnation}
            log.info("run %s, incarnation %d, generation %d", self._name, self._run.incarnation,
                     self._run.generation.number, extra={"facts": {"event": "begin", **begun}})  # fmt: skip
            if self._network.listen:
                log.info("listening on %s", ", ".join(self._network.listen))
                self._warn_if_insecure()
            self._evaluations_logged = len(self._run.background_jobs.evaluations)
            on_ready(self._run)
            try:
                self._loop(session)
            except RefusedError:  # another coordinator of this name goes on; the run is whole
                self._run.leave()
                raise
            self._file_watch.check(monotonic(), at_once=True)
            self._run.leave()
            self._snapshot = mark_left(self._take_snapshot())
            for each in declared:
                each.undeclare()
            farewell = status_json.status(self._snapshot)
            session.put(keys.event_status(self._name), farewell, encoding="application/json")
        return self._run

    def _declare(self, session: zenoh.Session) -> list[Any]:
        name = self._name
        subscribe, answer = session.declare_subscriber, session.declare_queryable
        return [
            *(subscribe(keys.all_workers(kind, name), self._enqueue(kind)) for kind in ("result", "beat", "upload")),
            session.liveliness().declare_subscriber(
                keys.all_workers("live/worker", name), self._enqueue("token"), history=True
            ),
            answer(self._hello_key("*/*"), self._enqueue("hello")),
            answer(keys.control(name, "*"), self._enqueue("control")),
            *declare_status(session, name, lambda: self._snapshot, self._error_counter),
            *self._serve_bundle(session),
        ]

    def _enqueue(self, kind: str) -> Any:
        """A callback that only enqueues; what is too much is dropped, and a query then ends without an answer."""

        def enqueue(event: Any) -> None:
            size = len(event.payload) if event.payload is not None else 0
            if not self._events.put(kind, event, size, monotonic()) and isinstance(event, zenoh.Query):
                event.drop()  # type: ignore[no-untyped-call]

        return zenoh.handlers.Callback(enqueue, indirect=False)

    def _loop(self, session: zenoh.Session) -> None:
        taken = monotonic()
        while not self._stopping and self._run.ended is None:
            self._drain_events()
            now = monotonic()
            self._worker_protocol.tick(now)
            if self._run.advance(now):
                self._put(
                    session, self._worker_protocol.dispatch(now, durable=False)
                )  # workers need not wait for the disk
            self._run.commit()
            self._put(session, self._worker_protocol.dispatch(now))
            self._run.prepare()
            # Before anything is said of it: who hears that a run is paused, and asks, is not told that it runs.
            if now - taken >= SNAPSHOT_INTERVAL or self._run.state != self._snapshot.status.state:
                self._snapshot, taken = self._take_snapshot(), now
                self._warn_if_no_worker(now)
                self._log_summary(now)
            self._publish_closed(session)
            self._write_notes()
            if self._draining and not self._worker_protocol.lease_count:
                self.stop()
            self._disband(session, now)
            self._file_watch.check(now)
            self._name_lock.check(now)
            self._check_revocations(now)

    def _put(self, session: zenoh.Session, sends: list[OutgoingBatch]) -> None:
        for send in sends:
            try:
                batch = self._encode_batch(send)
            except MalformedError as error:  # what this worker said led to it
                self._error_counter.record("batch", error, send.identity)
                self._worker_protocol.remove_worker(send.identity)
                continue
            session.put(keys.job(self._name, send.identity), batch, encoding=encoding(JobBatch))

    def _warn_if_insecure(self) -> None:
        if not self._secured and not all(is_loopback(each) for each in self._network.listen):
            log.warning("this is neither encrypted nor authenticated: anyone who reaches the port owns the run "
                        "(docs/security.md)", extra={"facts": {"event": "insecure"}})  # fmt: skip

    def _warn_if_no_worker(self, now: float) -> None:
        """Say once that nobody works, when that has lasted a while: a run that stands still should not be silent."""
        if self._run.state != "waiting for workers":
            self._no_worker_since = now
        elif now - self._no_worker_since > NO_WORKER_SECONDS:
            self._no_worker_since = math.inf
            command = worker_command(self._network, self._name, self._run.settings.task.task)
            log.warning("no worker is there: the run waits for one; on any host: %s", command,
                        extra={"facts": {"event": "no worker", "command": command}})  # fmt: skip

    def _log_summary(self, now: float) -> None:
        """One line a minute: who looks into the log sees how the run is."""
        if now - self._summary_logged_at >= SUMMARY_INTERVAL:
            self._summary_logged_at = now
            text, facts = summary(full_status(self._snapshot))
            log.info("%s", text, extra={"facts": facts})
            self._warn_of_expiry(now)

    def _warn_of_expiry(self, now: float) -> None:
        """Say so once a day from a week before on: links break when a certificate ends."""
        credentials = self._network.credentials
        if credentials is None or now < self._expiry_at:
            return
        self._expiry_at = now + DAY
        if (left := credentials.time_left(datetime.now(UTC))) < EXPIRY_WARNING:
            facts = {"event": "expiry", "seconds": left.total_seconds()}
            log.warning("this coordinator's join file: %s; issue another and start it again with that",
                        describe_time_left(left), extra={"facts": facts})  # fmt: skip

    def _write_notes(self) -> None:
        for record in self._worker_protocol.take_notes():
            log.info("%s", record)

    def _drain_events(self) -> None:
        """Handle what has arrived, waiting at most a tick for the first; what follows closely shares its commit."""
        try:
            self._handle(*self._events.get(timeout=TICK))
            until = monotonic() + LINGER
            for _ in range(MOST_EVENTS_PER_COMMIT):
                left = (
                    until - monotonic() if self._worker_protocol.jobs else 0.0
                )  # else a generation's end waits for us
                self._handle(*self._events.get(timeout=max(left, 0.0)))
        except queue.Empty:
            pass

    def _handle(self, kind: str, event: Any) -> None:
        """One event. What raises costs that event alone, for no message may end the run: its sender repeats it.

        Our own expected failures pass: a journal that cannot be written ends the coordinator.
        """
        try:
            self._handle_event(kind, event, monotonic())
        except MalformedError as error:
            self._error_counter.record(kind, error, event)
        except DreamfleetError:
            raise
        except Exception as error:
            self._error_counter.record(kind, error, event)

    def _handle_event(self, kind: str, event: Any, now: float) -> None:
        if kind == "hello":
            self._handle_hello(event, now)
        elif kind == "control":
            self._handle_control(event)
        elif kind == "token":
            if event.kind == zenoh.SampleKind.DELETE:
                self._worker_protocol.handle_departure(keys.worker_from_key(str(event.key_expr)), now)
        elif kind in _WORKER_MESSAGES:
            self._handle_worker_message(kind, event, now)

    def _handle_worker_message(self, kind: str, sample: zenoh.Sample, now: float) -> None:
        """Pass on what a worker of this run says, if it is of the schema."""
        worker = keys.worker_from_key(str(sample.key_expr))
        if self._is_revoked(worker):
            self._inbox.dropped["revoked"] += 1
            return
        message = self._inbox.decode(_WORKER_MESSAGES[kind], sample.payload.to_bytes())
        if message is None or not self._is_own_run(message.run_uid):
            return
        if isinstance(message, ResultBatch):
            self._worker_protocol.handle_results(worker, message, now)
        elif isinstance(message, UploadPart):
            self._worker_protocol.upload(worker, message, now)
        elif isinstance(message, Heartbeat) and message.nonce == self._nonce:
            self._worker_protocol.handle_heartbeat(worker, message, now)

    def _is_own_run(self, run_uid: str) -> bool:
        if run_uid != self._run.uid:
            self._inbox.dropped["foreign run"] += 1
        return run_uid == self._run.uid

    def _is_revoked(self, worker: str) -> bool:
        """Whether the seat that a worker's name ends in, to which the router holds it, was taken back."""
        return self._revocations is not None and worker_seat_identity(worker) in self._revocations.revoked_seats

    def _check_revocations(self, now: float) -> None:
        """End the leases of workers whose seats were taken back since the last look."""
        if self._revocations is None:
            return
        before = self._revocations.revoked_seats
        self._revocations.reload_if_changed(now)
        if self._revocations.revoked_seats != before:
            for member in list(self._worker_protocol.members):
                if self._is_revoked(member.identity):
                    self._worker_protocol.remove_worker(member.identity)

    def _handle_hello(self, query: zenoh.Query, now: float) -> None:
        with query:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            request = self._inbox.decode_json(HelloRequest, payload)
            refusal = malformed_hello(request) or self._identity_refusal(request, query)
            if self._disbanding_since is not None:
                refusal = refusal or ("the run ends with its workers", "wait until somebody goes on with it")
            if request is not None and refusal is None:
                refusal = self._worker_protocol.find_refusal(request, self._run.settings)
            numbering = 0
            if request is not None and refusal is None:
                numbering = self._worker_protocol.admit(request, now)
            why, remedy = refusal or ("", "")
            reply = hello_reply(self._run, self._name, self._nonce, self._intervals, why, remedy, numbering)
            key = self._hello_key(keys.worker_from_key(str(query.key_expr)))
            query.reply(key, encode_json(reply), encoding="application/json")

    def _hello_key(self, worker: str) -> str:
        """Where hello is said: in a secured fleet under a worker's own name."""
        return keys.secured_hello(self._name, worker) if self._secured else keys.hello(self._name)

    def _identity_refusal(self, request: HelloRequest | None, query: zenoh.Query) -> tuple[str, str] | None:
        """Why nobody of this name is let in, in a secured fleet, and what to do about it."""
        if not self._secured or request is None:
            return None
        if request.worker != keys.worker_from_key(str(query.key_expr)):
            return "it says hello in another's name", "update dreamfleet on the worker's host"
        if self._is_revoked(request.worker):
            self._worker_protocol.refused_workers.add(request.worker, "its join file is revoked")
            return "its join file is revoked", "have another issued"
        return None

    def _handle_control(self, query: zenoh.Query) -> None:
        verbs: dict[str, Callable[[], None]] = {
            "pause": lambda: self._run.pause("by hand"),
            "resume": self._resume,
            "drain": self._drain_run,
            "stop": self.stop,
            "disband": self._start_disbanding,
        }
        with query:
            query_key = str(query.key_expr)
            reply = control_reply(self._name, query_key, verbs, self._file_watch.command)
            if reply.accepted:
                verbs[control_verb(query_key)]()
            self._snapshot = self._take_snapshot()  # who asks after the answer sees what came of it
            query.reply(query.key_expr, encode_json(reply), encoding="application/json")

    def _resume(self) -> None:
        self._draining = False
        self._run.resume()

    def _drain_run(self) -> None:
        self._draining = True
        self._run.pause("draining")

    def _start_disbanding(self) -> None:
        self._run.pause("ending with its workers")
        self._disbanding_since = monotonic()

    def _disband(self, session: zenoh.Session, now: float) -> None:
        """Tell the workers to leave, again and again; stop when all have, or take too long."""
        if self._disbanding_since is None:
            return
        there = [each for each in self._worker_protocol.members if each.gone_since is None]
        if not there or now - self._disbanding_since > DISBAND_TIMEOUT:
            self.stop()
        elif now - self._leave_sent_at >= self._intervals.beat:
            self._leave_sent_at = now
            self._put(session, [OutgoingBatch(each.identity, each.numbering, 0, BatchContent()) for each in there])

    def _encode_batch(self, send: OutgoingBatch) -> bytes:
        content = send.content
        return encode(
            JobBatch(
                run_uid=self._run.uid,
                incarnation=self._run.incarnation,
                nonce=self._nonce,
                numbering=send.numbering,
                number=send.number,
                vectors=tuple(content.vectors),
                jobs=tuple(work.job for work in content.work),
                cancels=tuple(content.cancels),
                verdicts=tuple(content.verdicts),
                leave=self._disbanding_since is not None,
            )
        )

    def _publish_closed(self, session: zenoh.Session) -> None:
        for closed in self._run.take_closed():
            event = GenerationEvent(
                v=keys.PROTOCOL_VERSION,
                run=self._name,
                run_uid=self._run.uid,
                incarnation=self._run.incarnation,
                generation=closed.number,
                mean=closed.mean,
                std=closed.std,
                best=closed.best,
                worst=closed.worst,
                sigma=closed.sigma,
                seconds=closed.seconds,
                environment_steps=self._run.history.steps,
            )
            session.put(keys.event_generation(self._name), encode_json(event), encoding="application/json")
            log.info("generation %d: mean %.1f, best %.1f", closed.number, closed.mean, closed.best,
                     extra={"facts": {"event": "generation", **asdict(closed)}})  # fmt: skip
        evaluations = self._run.background_jobs.evaluations
        if len(evaluations) > self._evaluations_logged:
            for each in islice(evaluations.finished.values(), self._evaluations_logged, None):  # as they finished
                log.info("evaluation of generation %d's mean: %.1f ± %.1f (standard error), %d episodes",
                         each.generation, each.mean, each.error, each.episodes,
                         extra={"facts": {"event": "evaluation", **asdict(each), "error": each.error}})  # fmt: skip
            self._evaluations_logged = len(evaluations)

    def _take_snapshot(self) -> Snapshot:
        now = monotonic()
        dropped = (
            self._inbox.dropped + self._worker_protocol.dropped + self._events.dropped + self._error_counter.counts
        )
        credentials = self._network.credentials
        expires = None if credentials is None else credentials.expires.timestamp()
        return take_snapshot(self._run, self._name, dropped, now - self._started, now, expires)

    def _serve_bundle(self, session: zenoh.Session) -> list[Any]:
        """Serve the run's world model, if its task needs one."""
        sha256 = self._run.settings.task.bundle
        if self._bundle is None:
            return []
        head = {"run_uid": self._run.uid, "incarnation": self._run.incarnation, "sha256": bytes.fromhex(sha256)}
        server = BundleServer(self._bundle, keys.bundle(self._name, sha256), head)
        return [server.declare(session, self._error_counter)]
