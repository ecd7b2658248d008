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

from dreamfleet.common import keys
from dreamfleet.common.codec import Inbox, MalformedError, encode, encode_json, encoding
from dreamfleet.common.credentials import SOON, seat_of_worker, told_left
from dreamfleet.common.errors import DreamfleetError, RefusedError
from dreamfleet.common.ledger import Revocations
from dreamfleet.common.messages import (
    Beat,
    GenerationEvent,
    HelloRequest,
    Intervals,
    JobBatch,
    Message,
    ResultBatch,
    UploadPart,
)
from dreamfleet.common.mishaps import Mishaps
from dreamfleet.common.network import is_loopback
from dreamfleet.common.session import Network, open_session
from dreamfleet.coordinator import answers
from dreamfleet.coordinator.arrivals import Arrivals
from dreamfleet.coordinator.claim import Claim
from dreamfleet.coordinator.custody import Custody
from dreamfleet.coordinator.fleet import Send
from dreamfleet.coordinator.lines import summary, worker_command
from dreamfleet.coordinator.packing import Content
from dreamfleet.coordinator.queryables import BundleServer, answer_status
from dreamfleet.coordinator.replies import control_reply, control_verb, hello_reply, misunderstanding
from dreamfleet.coordinator.run import Run
from dreamfleet.coordinator.scrape import metrics_served
from dreamfleet.coordinator.served import ServedBundle
from dreamfleet.coordinator.status import Snapshot, as_left, status_of, take_snapshot

log = logging.getLogger(__name__)
TICK = 0.05  # seconds: the longest that a loss waits to be acted upon
DRAIN = 256  # events that share one commit at most
LINGER = 0.005  # seconds that a commit waits for more to share it
SNAPSHOT_INTERVAL = 0.2
SUMMARY = 60.0  # seconds from one line about the run to the next
DISBANDING = 10.0  # seconds that workers may take to leave a run that ends with them
DAY = 86_400.0  # seconds from one warning of the join file's end to the next
ALONE = 5.0  # seconds without a worker after which the log says so
_REPEATED: dict[str, type[Message]] = {"result": ResultBatch, "beat": Beat, "upload": UploadPart}


class Service:
    """Serves one run until it ends or `stop` is called."""

    def __init__(
        self, name: str, network: Network, intervals: Intervals, custody: Custody, bundle: ServedBundle | None,
        metrics_port: str = "", revocations: Revocations | None = None,
    ) -> None:  # fmt: skip
        self._name = name
        self._custody = custody
        self._bundle = bundle
        self._network = network
        self._secured = network.credentials is not None
        self._revocations = revocations
        self._metrics_port = metrics_port
        self._intervals = intervals
        self._nonce = secrets.token_hex(8)
        self._events = Arrivals()
        self._inbox = Inbox()
        self._mishaps = Mishaps(log)
        self._stopping = self._draining = False
        self._disbanding_since: float | None = None  # every batch then says `leave`
        self._told_at = -math.inf
        self._evaluations_told = 0
        self._expiry_at = 0.0

    def stop(self) -> None:
        """End the loop soon; the run can be continued. Safe in a signal handler."""
        self._stopping = True
        self._events.wake()

    def serve(self, run_maker: Callable[[], Run], on_ready: Callable[[Run], None] = lambda _run: None) -> Run:
        """Claim the name on the wire, make the run, serve it; the run as it was when the service left."""
        with ExitStack() as last, open_session(self._network) as session, ExitStack() as stack:
            self._claim = Claim(session, self._name, self._nonce, stack)
            self._claim.take()
            self._run = run_maker()
            self._claim.announce(self._run.uid, self._run.incarnation)
            self._exchange = self._run.exchange
            self._started = self._alone_since = self._summed_up = monotonic()
            self._snapshot = self._take_snapshot()
            last.enter_context(metrics_served(self._metrics_port, lambda: self._snapshot, lambda: self._stopping))
            declared = self._declare(session)
            begun = {"run": self._name, "run_uid": self._run.uid, "incarnation": self._run.incarnation}
            log.info("run %s, incarnation %d, generation %d", self._name, self._run.incarnation,
                     self._run.generation.number, extra={"facts": {"event": "begin", **begun}})  # fmt: skip
            if self._network.listen:
                log.info("listening on %s", ", ".join(self._network.listen))
                self._tell_open()
            self._evaluations_told = len(self._run.slack.evaluations)
            on_ready(self._run)
            try:
                self._loop(session)
            except RefusedError:  # another coordinator of this name goes on; the run is whole
                self._run.leave()
                raise
            self._custody.look(monotonic(), at_once=True)
            self._run.leave()
            self._snapshot = as_left(self._take_snapshot())
            for each in declared:
                each.undeclare()
            farewell = answers.status(self._snapshot)
            session.put(keys.event_status(self._name), farewell, encoding="application/json")
        return self._run

    def _declare(self, session: zenoh.Session) -> list[Any]:
        name = self._name
        subscribe, answer = session.declare_subscriber, session.declare_queryable
        return [
            *(subscribe(keys.any_worker(kind, name), self._enqueue(kind)) for kind in ("result", "beat", "upload")),
            session.liveliness().declare_subscriber(
                keys.any_worker("live/worker", name), self._enqueue("token"), history=True
            ),
            answer(self._hello_key("*/*"), self._enqueue("hello")),
            answer(keys.control(name, "*"), self._enqueue("control")),
            *answer_status(session, name, lambda: self._snapshot, self._mishaps),
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
            self._exchange.tick(now)
            if self._run.advance(now):
                self._put(session, self._exchange.dispatch(now, durable=False))  # workers need not wait for the disk
            self._run.commit()
            self._put(session, self._exchange.dispatch(now))
            self._run.prepare()
            # Before anything is said of it: who hears that a run is paused, and asks, is not told that it runs.
            if now - taken >= SNAPSHOT_INTERVAL or self._run.state != self._snapshot.status.state:
                self._snapshot, taken = self._take_snapshot(), now
                self._tell_alone(now)
                self._tell_summary(now)
            self._publish_closed(session)
            self._write_notes()
            if self._draining and not self._exchange.leased:
                self.stop()
            self._disband(session, now)
            self._custody.look(now)
            self._claim.look(now)
            self._look_at_revocations(now)

    def _put(self, session: zenoh.Session, sends: list[Send]) -> None:
        for send in sends:
            try:
                batch = self._batch(send)
            except MalformedError as error:  # what this worker said led to it
                self._mishaps.note("batch", error, send.identity)
                self._exchange.dismiss(send.identity)
                continue
            session.put(keys.job(self._name, send.identity), batch, encoding=encoding(JobBatch))

    def _tell_open(self) -> None:
        if not self._secured and not all(is_loopback(each) for each in self._network.listen):
            log.warning("this is neither encrypted nor authenticated: anyone who reaches the port owns the run "
                        "(docs/security.md)", extra={"facts": {"event": "insecure"}})  # fmt: skip

    def _tell_alone(self, now: float) -> None:
        """Say once that nobody works, when that has lasted a while: a run that stands still should not be silent."""
        if self._run.state != "waiting for workers":
            self._alone_since = now
        elif now - self._alone_since > ALONE:
            self._alone_since = math.inf
            command = worker_command(self._network, self._name, self._run.settings.task.task)
            log.warning("no worker is there: the run waits for one; on any host: %s", command,
                        extra={"facts": {"event": "no worker", "command": command}})  # fmt: skip

    def _tell_summary(self, now: float) -> None:
        """One line a minute: who looks into the log sees how the run is."""
        if now - self._summed_up >= SUMMARY:
            self._summed_up = now
            text, facts = summary(status_of(self._snapshot))
            log.info("%s", text, extra={"facts": facts})
            self._tell_expiry(now)

    def _tell_expiry(self, now: float) -> None:
        """Say so once a day from a week before on: links break when a certificate ends."""
        credentials = self._network.credentials
        if credentials is None or now < self._expiry_at:
            return
        self._expiry_at = now + DAY
        if (left := credentials.left(datetime.now(UTC))) < SOON:
            facts = {"event": "expiry", "seconds": left.total_seconds()}
            log.warning("this coordinator's join file: %s; issue another and start it again with that",
                        told_left(left), extra={"facts": facts})  # fmt: skip

    def _write_notes(self) -> None:
        for note in self._exchange.take_notes():
            log.info("%s", note)

    def _drain_events(self) -> None:
        """Handle what has arrived, waiting at most a tick for the first; what follows closely shares its commit."""
        try:
            self._handle(*self._events.get(timeout=TICK))
            until = monotonic() + LINGER
            for _ in range(DRAIN):
                left = until - monotonic() if self._exchange.jobs else 0.0  # else a generation's end waits for us
                self._handle(*self._events.get(timeout=max(left, 0.0)))
        except queue.Empty:
            pass

    def _handle(self, kind: str, event: Any) -> None:
        """One event. What raises costs that event alone, for no message may end the run: its sender repeats it.

        Our own expected failures pass: a journal that cannot be written ends the coordinator.
        """
        try:
            self._take(kind, event, monotonic())
        except MalformedError as error:
            self._mishaps.note(kind, error, event)
        except DreamfleetError:
            raise
        except Exception as error:
            self._mishaps.note(kind, error, event)

    def _take(self, kind: str, event: Any, now: float) -> None:
        if kind == "hello":
            self._hello(event, now)
        elif kind == "control":
            self._control(event)
        elif kind == "token":
            if event.kind == zenoh.SampleKind.DELETE:
                self._exchange.depart(keys.worker_of(str(event.key_expr)), now)
        elif kind in _REPEATED:
            self._hear(kind, event, now)

    def _hear(self, kind: str, sample: zenoh.Sample, now: float) -> None:
        """Pass on what a worker of this run says, if it is of the schema."""
        worker = keys.worker_of(str(sample.key_expr))
        if self._barred(worker):
            self._inbox.dropped["revoked"] += 1
            return
        message = self._inbox.decode(_REPEATED[kind], sample.payload.to_bytes())
        if message is None or not self._ours(message.run_uid):
            return
        if isinstance(message, ResultBatch):
            self._exchange.results(worker, message, now)
        elif isinstance(message, UploadPart):
            self._exchange.upload(worker, message, now)
        elif isinstance(message, Beat) and message.nonce == self._nonce:
            self._exchange.beat(worker, message, now)

    def _ours(self, run_uid: str) -> bool:
        if run_uid != self._run.uid:
            self._inbox.dropped["foreign run"] += 1
        return run_uid == self._run.uid

    def _barred(self, worker: str) -> bool:
        """Whether the seat that a worker's name ends in, to which the router holds it, was taken back."""
        return self._revocations is not None and seat_of_worker(worker) in self._revocations.barred

    def _look_at_revocations(self, now: float) -> None:
        """End the leases of workers whose seats were taken back since the last look."""
        if self._revocations is None:
            return
        before = self._revocations.barred
        self._revocations.look(now)
        if self._revocations.barred != before:
            for member in list(self._exchange.members):
                if self._barred(member.identity):
                    self._exchange.dismiss(member.identity)

    def _hello(self, query: zenoh.Query, now: float) -> None:
        with query:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            request = self._inbox.decode_json(HelloRequest, payload)
            refusal = misunderstanding(request) or self._impostor(request, query)
            if self._disbanding_since is not None:
                refusal = refusal or ("the run ends with its workers", "wait until somebody goes on with it")
            if request is not None and refusal is None:
                refusal = self._exchange.refusal(request, self._run.settings)
            numbering = 0
            if request is not None and refusal is None:
                numbering = self._exchange.admit(request, now)
            why, remedy = refusal or ("", "")
            reply = hello_reply(self._run, self._name, self._nonce, self._intervals, why, remedy, numbering)
            key = self._hello_key(keys.worker_of(str(query.key_expr)))
            query.reply(key, encode_json(reply), encoding="application/json")

    def _hello_key(self, worker: str) -> str:
        """Where hello is said: in a secured fleet under a worker's own name."""
        return keys.hello_of(self._name, worker) if self._secured else keys.hello(self._name)

    def _impostor(self, request: HelloRequest | None, query: zenoh.Query) -> tuple[str, str] | None:
        """Why nobody of this name is let in, in a secured fleet, and what to do about it."""
        if not self._secured or request is None:
            return None
        if request.worker != keys.worker_of(str(query.key_expr)):
            return "it says hello in another's name", "update dreamfleet on the worker's host"
        if self._barred(request.worker):
            self._exchange.refusals.add(request.worker, "its join file is revoked")
            return "its join file is revoked", "have another issued"
        return None

    def _control(self, query: zenoh.Query) -> None:
        verbs: dict[str, Callable[[], None]] = {
            "pause": lambda: self._run.pause("by hand"),
            "resume": self._resume,
            "drain": self._drain_run,
            "stop": self.stop,
            "disband": self._begin_to_disband,
        }
        with query:
            asked_at = str(query.key_expr)
            reply = control_reply(self._name, asked_at, verbs, self._custody.command)
            if reply.accepted:
                verbs[control_verb(asked_at)]()
            self._snapshot = self._take_snapshot()  # who asks after the answer sees what came of it
            query.reply(query.key_expr, encode_json(reply), encoding="application/json")

    def _resume(self) -> None:
        self._draining = False
        self._run.resume()

    def _drain_run(self) -> None:
        self._draining = True
        self._run.pause("draining")

    def _begin_to_disband(self) -> None:
        self._run.pause("ending with its workers")
        self._disbanding_since = monotonic()

    def _disband(self, session: zenoh.Session, now: float) -> None:
        """Tell the workers to leave, again and again; stop when all have, or take too long."""
        if self._disbanding_since is None:
            return
        there = [each for each in self._exchange.members if each.lost is None]
        if not there or now - self._disbanding_since > DISBANDING:
            self.stop()
        elif now - self._told_at >= self._intervals.beat:
            self._told_at = now
            self._put(session, [Send(each.identity, each.numbering, 0, Content()) for each in there])

    def _batch(self, send: Send) -> bytes:
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
        evaluations = self._run.slack.evaluations
        if len(evaluations) > self._evaluations_told:
            for each in islice(evaluations.finished.values(), self._evaluations_told, None):  # as they finished
                log.info("evaluation of generation %d's mean: %.1f ± %.1f (standard error), %d episodes",
                         each.generation, each.mean, each.error, each.episodes,
                         extra={"facts": {"event": "evaluation", **asdict(each), "error": each.error}})  # fmt: skip
            self._evaluations_told = len(evaluations)

    def _take_snapshot(self) -> Snapshot:
        now = monotonic()
        dropped = self._inbox.dropped + self._exchange.dropped + self._events.dropped + self._mishaps.counts
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
        return [server.declare(session, self._mishaps)]
