"""The coordinator on Zenoh: callbacks only enqueue events, or answer from a snapshot; one thread handles the events.

Life: startup (session, name lock, queryables) -> loop (events, advance, commit, dispatch) -> shutdown.
"""

import logging
import queue
import secrets
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from time import monotonic
from typing import Any

import zenoh

from dreamfleet.common.errors import AccessError, DreamfleetError, JournalError, NotWritableNowError, RefusedError
from dreamfleet.common.host.add_ons import add_on
from dreamfleet.common.host.error_counter import ErrorCounter
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder, encode, encode_json, encoding
from dreamfleet.common.protocol.messages import (
    GenerationEvent,
    Heartbeat,
    HelloRequest,
    Intervals,
    JobBatch,
    ResultBatch,
    UploadPart,
)
from dreamfleet.common.runs.records import StoredGeneration
from dreamfleet.common.schema.validation import MalformedError
from dreamfleet.common.security.certificate_ledger import RevocationWatcher
from dreamfleet.common.security.credentials import worker_seat_identity
from dreamfleet.common.transport.link_check import LinkCheck
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.coordinator.dispatch.packing import SentBatch
from dreamfleet.coordinator.dispatch.refusals import Refusal
from dreamfleet.coordinator.run.batches import Batches
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.run.run_state import Ended
from dreamfleet.coordinator.run.shown_state import shown_state
from dreamfleet.coordinator.run.worker_protocol import WorkerMessage, WorkerProtocol
from dreamfleet.coordinator.service.batch_queries import BatchQueries
from dreamfleet.coordinator.service.control import Control
from dreamfleet.coordinator.service.inbound_queue import InboundQueue
from dreamfleet.coordinator.service.name_lock import NameLock
from dreamfleet.coordinator.service.queryables import declare_bundle, declare_status
from dreamfleet.coordinator.service.run_log import RunLog
from dreamfleet.coordinator.service.snapshot import Snapshot, take_snapshot
from dreamfleet.coordinator.service.status import encode_status
from dreamfleet.coordinator.storage.file_watch import FileWatch
from dreamfleet.coordinator.storage.kept_revocations import KeptRevocations
from dreamfleet.coordinator.storage.served_bundle import ServedBundle

log = logging.getLogger(__name__)
TICK = 0.05  # seconds: the longest that a lost worker waits to be noticed
MOST_EVENTS = 256  # events of a turn at most
LINGER = 0.005  # seconds from one commit to the next at least while workers hold jobs, so that results share one
LONGEST_LINGER = 0.2  # seconds from one commit to the next at most, however slow the disk is
SNAPSHOT_INTERVAL = 0.2
END_GRACE = 2.0  # seconds that workers may take to leave a run that has ended
_WORKER_MESSAGES: dict[str, type[WorkerMessage]] = {"result": ResultBatch, "beat": Heartbeat, "upload": UploadPart}


@dataclass(frozen=True)
class OpenRun:
    """A run to serve, with its files."""

    run: Run
    file_watch: FileWatch
    bundle: ServedBundle | None


class Service:
    """Serves one run until it ends or `stop` is called."""

    def __init__(
        self, name: str, network: Network, intervals: Intervals, metrics_port: str, revocations: RevocationWatcher,
        score_word: str,
    ) -> None:  # fmt: skip
        self._name = name
        self._network = network
        self._secured = network.credentials is not None
        self._revocations = revocations
        self._score_word = score_word
        self._metrics_port = metrics_port
        self._intervals = intervals
        self._nonce = secrets.token_hex(8)
        self._link_check = LinkCheck(network, log)
        self._events = InboundQueue()
        self._inbox = CountingDecoder()
        self._error_counter = ErrorCounter(log)
        self._stopping = False
        self.is_asked_to_stop = False  # by somebody, so no other incarnation goes on
        self._commit_at = 0.0  # before that a commit waits for further results
        self._has_uncommitted = False  # whether the last turn left its commit to a later one

    def stop(self) -> None:
        """End the loop soon; the run can be continued. Safe in a signal handler."""
        self._stopping = self.is_asked_to_stop = True
        self._events.wake()

    def serve(self, open_run: Callable[[], OpenRun]) -> Run:
        """Claim all addresses and the name on the network, then open the run and serve it; the run as it was left."""
        with ExitStack() as last, ExitStack() as stack:
            session = stack.enter_context(open_session(self._network))
            self._name_lock = NameLock(session, self._name, self._nonce, stack)
            self._name_lock.acquire(linked=bool(self._network.connect))
            if self._metrics_port:
                serve_metrics = add_on("serve-metrics")
                last.enter_context(serve_metrics(self._metrics_port, lambda: self._snapshot, lambda: self._stopping))
            self._start(open_run())
            self._declared = self._declare(session)
            self._run_log.begin()
            try:
                while self._loop(session):
                    session = self._open_again(session, stack)
                if not self._run.state.is_rewound:
                    self._shut_down(session)
            except JournalError:
                self._file_watch.check(monotonic(), at_once=True)  # what was done to the files may be rescued
                raise
            except RefusedError:  # another coordinator of this name continues; nothing of the run is lost
                self._run.leave()
                raise
            except AccessError as error:
                self._run.leave()
                raise AccessError(
                    f"{error}; put it in the old one's place and run: {self._file_watch.command}"
                ) from error
        return self._run

    def _open_again(self, session: zenoh.Session, stack: ExitStack) -> zenoh.Session:
        """Serve the run on a session with another id, or go on with this one if no router answers after all."""
        if self._network.listen:
            stack.close()  # the port is needed
            network = replace(self._network, revoked_seats=self._revocations.revoked_seats)
            fresh = open_session(network, timeout=None)
        else:
            try:
                fresh = open_session(self._network)
            except DreamfleetError:
                return session
            stack.close()
        stack.enter_context(fresh)
        self._name_lock.move(fresh)
        self._declared = self._declare(fresh)
        return fresh

    def _start(self, opened: OpenRun) -> None:
        self._run, self._file_watch, self._bundle = opened.run, opened.file_watch, opened.bundle
        run, name = opened.run, self._name
        self._name_lock.announce(run.uid, run.incarnation)
        self._protocol = WorkerProtocol(run, name, self._nonce, self._intervals)
        self._control = Control(run, name, self._intervals.beat, self.stop)
        self._batch_queries = BatchQueries(Batches(run, name), name)
        self._kept_revocations = KeptRevocations(run.journal, self._revocations.authority)
        self._kept_revocations.keep(self._revocations.revoked_seats)
        self._started = monotonic()
        self._run_log = RunLog(run, name, self._network, self._started)
        self._snapshot = self._take_snapshot()

    def _declare(self, session: zenoh.Session) -> list[Any]:
        """Answer for the run from now on; what is declared on the session."""
        run, name = self._run, self._name
        subscribe, answer = session.declare_subscriber, session.declare_queryable
        declared = [
            *(subscribe(keys.all_workers(kind, name), self._enqueue(kind)) for kind in _WORKER_MESSAGES),
            session.liveliness().declare_subscriber(
                keys.all_workers("live/worker", name), self._enqueue("token"), history=True
            ),
            answer(self._hello_key("*/*"), self._enqueue("hello")),
            answer(keys.control(name, "*"), self._enqueue("control")),
            answer(keys.batch(name, "*"), self._enqueue("batch")),
            *declare_status(session, name, lambda: self._snapshot, self._error_counter),
        ]
        if self._bundle is not None:
            sha256 = run.settings.task.bundle
            head = {"run_uid": run.uid, "incarnation": run.incarnation, "sha256": bytes.fromhex(sha256)}
            key = keys.bundle(name, sha256)
            declared.append(declare_bundle(session, key, self._bundle, head, self._error_counter))
        return declared

    def _loop(self, session: zenoh.Session) -> bool:
        snapshot_at, published = monotonic(), len(self._run.history)
        while not (self._stopping or isinstance(self._run.state, Ended)):
            self._drain_events()
            now = monotonic()
            self._run.tick(now)
            opened = self._run.advance(now)
            if not self._run.state.is_rewound:  # jobs need not wait for the disk; docs/explanation/decisions.md
                self._put(session, self._run.fleet.dispatch(now, durable=False))
            self._has_uncommitted = not (opened or self._is_commit_due(now))
            if self._has_uncommitted:
                continue
            durable = self._commit()
            if self._run.state.is_rewound:  # no verdict: the next incarnation counts what workers still hold
                self._run_log.write_notes()
                self._stopping = self._stopping or durable
                continue
            self._put(session, self._run.fleet.dispatch(now, durable=durable))
            self._run.generations.prepare()
            # A new state is in the snapshot before it is announced: a client that hears of it and asks must see it.
            if now - snapshot_at >= SNAPSHOT_INTERVAL or shown_state(self._run).word != self._snapshot.status.state:
                self._snapshot, snapshot_at = self._take_snapshot(), now
                self._run_log.check(self._snapshot, now)
            closed = self._run.history.rows[published:]
            published += len(closed)
            self._publish(session, closed)
            self._batch_queries.send(session, (each.number for each in closed), now, durable=durable)
            self._run_log.report_closed(closed)
            self._run_log.write_notes()
            self._put(session, self._control.advance(now))
            self._file_watch.check(now)
            self._name_lock.check(now)
            self._check_revocations(now)
            if self._link_check.find_apart(session, now):
                return True
        return False

    def _shut_down(self, session: zenoh.Session) -> None:
        """Make the run durable, stop answering, and publish the last status."""
        self._file_watch.check(monotonic(), at_once=True)
        self._run.leave()
        self._batch_queries.send(session, (), monotonic(), durable=True)
        self._snapshot = self._take_snapshot().as_left()
        if self._run.state.ended is not None:
            self._dismiss_workers(session)
        for each in self._declared:
            each.undeclare()
        session.put(keys.event_status(self._name), encode_status(self._snapshot), encoding="application/json")

    def _dismiss_workers(self, session: zenoh.Session) -> None:
        """Say to the workers that the run has ended, and wait briefly until they are gone.

        R24: without this word such a worker would wait for another incarnation of the coordinator.
        """
        until = monotonic() + END_GRACE
        self._put(session, self._control.last_batches(), ended=True)
        with suppress(queue.Empty):
            while self._control.last_batches():
                kind, event = self._events.get(timeout=max(until - monotonic(), 0.0))
                if kind in ("token", "beat"):
                    self._handle(kind, event)
                elif isinstance(event, zenoh.Query):
                    event.drop()  # type: ignore[no-untyped-call]

    def _enqueue(self, kind: str) -> Any:
        """A callback that only enqueues; if the queue is full, the event is dropped, a query without an answer."""

        def enqueue(event: Any) -> None:
            size = len(event.payload) if event.payload is not None else 0
            if not self._events.put(kind, event, size, monotonic()) and isinstance(event, zenoh.Query):
                event.drop()  # type: ignore[no-untyped-call]

        return zenoh.handlers.Callback(enqueue, indirect=False)

    def _put(self, session: zenoh.Session, batches: list[SentBatch], *, ended: bool = False) -> None:
        for batch in batches:
            try:
                message = encode(self._protocol.job_batch(batch, leave=self._control.disbanding, ended=ended))
            except MalformedError as error:  # caused by what this worker reported
                self._error_counter.record("batch", error, batch.identity)
                self._run.fleet.remove_worker(batch.identity)
                continue
            session.put(keys.job(self._name, batch.identity), message, encoding=encoding(JobBatch))

    def _is_commit_due(self, now: float) -> bool:
        """Whether the turn goes on to the disk: later while workers hold jobs whose results may share the commit."""
        goes_on = not (self._run.state.is_over or self._run.state.stalled)
        return (
            not (goes_on and self._run.fleet.lease_count) or now >= self._commit_at or self._batch_queries.has_waiting
        )

    def _commit(self) -> bool:
        """Commit; whether that succeeded."""
        began = monotonic()
        durable = self._run.commit()
        self._commit_at = next_commit(began, monotonic())
        return durable

    def _drain_events(self) -> None:
        """Handle the events that have arrived; without any, wait for one until a commit or a tick is due."""
        timeout = min(max(self._commit_at - monotonic(), 0.0), TICK) if self._has_uncommitted else TICK
        with suppress(queue.Empty):
            for _ in range(MOST_EVENTS):
                self._handle(*self._events.get(timeout=timeout))
                timeout = 0.0

    def _handle(self, kind: str, event: Any) -> None:
        """Handle one event. An exception drops that event alone, for no message may end the run: its sender repeats it.

        A full disk or a locked journal makes the run wait. Another `DreamfleetError` passes: it ends the coordinator.
        """
        try:
            self._handle_event(kind, event, monotonic())
        except MalformedError as error:
            self._error_counter.record(kind, error, event)
        except NotWritableNowError as error:
            self._run.wait_until_writable(error)
        except DreamfleetError:
            raise
        except Exception as error:
            self._error_counter.record(kind, error, event)

    def _handle_event(self, kind: str, event: Any, now: float) -> None:
        if kind == "hello":
            self._handle_hello(event, now)
        elif kind == "control":
            self._handle_control(event, now)
        elif kind == "batch":
            self._batch_queries.handle(event, now)
        elif kind == "token":
            if event.kind == zenoh.SampleKind.DELETE:
                self._run.fleet.handle_departure(keys.worker_from_key(str(event.key_expr)), now)
        elif kind in _WORKER_MESSAGES:
            self._handle_worker_message(kind, event, now)

    def _handle_worker_message(self, kind: str, sample: zenoh.Sample, now: float) -> None:
        worker = keys.worker_from_key(str(sample.key_expr))
        if self._is_revoked(worker):
            self._inbox.dropped["revoked"] += 1  # docs/explanation/threats.md
            return
        message: WorkerMessage | None = self._inbox.decode(_WORKER_MESSAGES[kind], sample.payload.to_bytes())
        if message is not None:
            self._protocol.handle(worker, message, now)

    def _handle_hello(self, query: zenoh.Query, now: float) -> None:
        with query:
            worker = keys.worker_from_key(str(query.key_expr))
            payload = query.payload.to_bytes() if query.payload is not None else b""
            request = self._inbox.decode_json(HelloRequest, payload)
            refusal = None if request is None else self._find_refusal(request, worker)
            reply = self._protocol.answer_hello(request, refusal, now)
            query.reply(self._hello_key(worker), encode_json(reply), encoding="application/json")

    def _hello_key(self, worker: str) -> str:
        """The key of hellos: in a secured fleet each worker has its own."""
        return keys.secured_hello(self._name, worker) if self._secured else keys.hello(self._name)

    def _find_refusal(self, request: HelloRequest, worker: str) -> Refusal | None:
        """Why the service admits nobody of this name, and what to do about it; `worker` is named by the hello's key."""
        if self._secured and request.worker != worker:
            return Refusal("it uses another worker's name", "update dreamfleet on the worker's host")
        if self._secured and self._is_revoked(request.worker):
            self._run.admission.refused_workers.add(request.worker, "its join file is revoked")
            return Refusal("its join file is revoked", "have another issued")
        if self._control.disbanding:
            return Refusal("the run ends with its workers", "wait until the run is resumed")
        return None

    def _is_revoked(self, worker: str) -> bool:
        """Whether the certificate of a worker's seat, which its name ends in, was revoked."""
        return worker_seat_identity(worker) in self._revocations.revoked_seats

    def _check_revocations(self, now: float) -> None:  # docs/how-to/security.md
        """Remove workers whose certificates were revoked since the last look; `AccessError` if the own file ended."""
        before = self._revocations.revoked_seats
        self._revocations.reload_if_changed(now)
        self._revocations.check_own_file()
        if self._revocations.revoked_seats != before:
            self._kept_revocations.keep(self._revocations.revoked_seats)
            for worker in list(self._run.fleet.members):
                if self._is_revoked(worker):
                    self._run.fleet.remove_worker(worker)

    def _handle_control(self, query: zenoh.Query, now: float) -> None:
        with query:
            host = query.parameters.get("host") or ""
            reply = self._control.obey(str(query.key_expr), self._file_watch.command, now, host)
            self._snapshot = self._take_snapshot()  # a client that asks after this answer must see its effect
            query.reply(query.key_expr, encode_json(reply), encoding="application/json")

    def _publish(self, session: zenoh.Session, generations: Sequence[StoredGeneration]) -> None:
        for closed in generations:
            event = GenerationEvent(
                v=keys.PROTOCOL_VERSION, run=self._name, run_uid=self._run.uid, incarnation=self._run.incarnation,
                generation=closed.number, mean=closed.mean, std=closed.std, best=closed.best, worst=closed.worst,
                sigma=closed.sigma, seconds=closed.seconds, environment_steps=self._run.history.steps,
            )  # fmt: skip
            session.put(keys.event_generation(self._name), encode_json(event), encoding="application/json")

    def _take_snapshot(self) -> Snapshot:
        now = monotonic()
        dropped = self._inbox.dropped + self._run.dropped + self._events.dropped + self._error_counter.counts
        credentials = self._network.credentials
        expires = None if credentials is None else credentials.expires.timestamp()
        return take_snapshot(self._run, self._name, dropped, now - self._started, now, expires, self._score_word)


def next_commit(began: float, ended: float) -> float:
    """When the next commit is due: it waits as long as the last one took, so that jobs get half of the time."""
    return ended + min(max(LINGER, ended - began), LONGEST_LINGER)
