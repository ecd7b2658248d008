"""The coordinator on Zenoh: one owner thread, one queue; callbacks only enqueue, or answer from a ready snapshot.

Life: startup (session, lock on the name, queryables) -> loop (events, advance, commit, dispatch) -> shutdown.
"""

from __future__ import annotations

import json
import logging
import queue
import secrets
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from time import monotonic
from typing import Any

import zenoh

from dreamfleet.common import keys
from dreamfleet.common.codec import Inbox, encode, encode_json, encoding
from dreamfleet.common.errors import RefusedError
from dreamfleet.common.fields import written
from dreamfleet.common.fingerprint import package_version
from dreamfleet.common.messages import (
    MAX_PART,
    Beat,
    BundlePart,
    ControlReply,
    GenerationEvent,
    HelloReply,
    HelloRequest,
    Intervals,
    JobBatch,
    ResultBatch,
    UploadPart,
)
from dreamfleet.common.session import Network, enqueue_into, open_session
from dreamfleet.common.status import PARTS
from dreamfleet.coordinator import answers
from dreamfleet.coordinator.claim import Claim
from dreamfleet.coordinator.custody import Custody
from dreamfleet.coordinator.fleet import Send
from dreamfleet.coordinator.run import Run
from dreamfleet.coordinator.served import ServedBundle
from dreamfleet.coordinator.status import Snapshot, as_left, take_snapshot

log = logging.getLogger(__name__)
TICK = 0.05  # seconds: the longest that a loss waits to be acted upon
DRAIN = 256  # events that share one commit at most
MOST_WAITING = 4096  # messages in the queue: at most 196 MB
LINGER = 0.005  # seconds that a commit waits for more to share it
SNAPSHOT_INTERVAL = 0.2


class Service:
    """Serves one run until it ends or `stop` is called."""

    def __init__(
        self, name: str, network: Network, intervals: Intervals, custody: Custody, bundle: ServedBundle | None
    ) -> None:
        self._name = name
        self._custody = custody
        self._bundle = bundle
        self._network = network
        self._intervals = intervals
        self._nonce = secrets.token_hex(8)
        self._events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._inbox = Inbox()
        self._overflow: Counter[str] = Counter()  # counted in Zenoh's threads, under the lock
        self._lock = threading.Lock()
        self._stopping = self._draining = False
        self._evaluations_told = 0

    def stop(self) -> None:
        """End the loop soon; the run can be continued. Safe in a signal handler."""
        self._stopping = True
        self._events.put(("wake", None))

    def serve(self, run_maker: Callable[[], Run], on_ready: Callable[[Run], None] = lambda _run: None) -> Run:
        """Claim the name on the wire, make the run, serve it; the run as it was when the service left."""
        with open_session(self._network) as session, ExitStack() as stack:
            self._claim = Claim(session, self._name, self._nonce, stack)
            self._claim.take()
            self._run = run_maker()
            self._claim.announce(self._run.uid, self._run.incarnation)
            self._exchange = self._run.exchange
            self._started = monotonic()
            self._snapshot = self._take_snapshot()
            declared = self._declare(session)
            log.info("run %s, incarnation %d, generation %d", self._name, self._run.incarnation,
                     self._run.generation.number)  # fmt: skip
            if self._network.listen:
                log.info("listening on %s", ", ".join(self._network.listen))
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
        name, events = self._name, self._events
        subscribe, answer = session.declare_subscriber, session.declare_queryable
        return [
            *(subscribe(keys.any_worker(kind, name), self._enqueue(kind)) for kind in ("result", "beat", "upload")),
            session.liveliness().declare_subscriber(
                keys.any_worker("live/worker", name), enqueue_into(events, "token"), history=True
            ),
            answer(keys.hello(name), enqueue_into(events, "hello")),
            answer(keys.control(name, "*"), enqueue_into(events, "control")),
            *(answer(keys.status(name, part), _callback(self._answer_status(part))) for part in PARTS),
            *(answer(keys.bundle(name, sha256), _callback(self._answer_bundle)) for sha256 in self._bundles),
        ]

    def _enqueue(self, kind: str) -> Any:
        """What is repeated anyway is dropped and counted while too much waits: a flood must not fill the memory."""

        def enqueue(sample: zenoh.Sample) -> None:
            if self._events.qsize() < MOST_WAITING:
                self._events.put((kind, sample))
            else:
                with self._lock:
                    self._overflow["too many at once"] += 1

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
            self._publish_closed(session)
            self._write_notes()
            if self._draining and not self._exchange.leased:
                self.stop()
            self._custody.look(now)
            self._claim.look(now)
            if now - taken >= SNAPSHOT_INTERVAL:
                self._snapshot, taken = self._take_snapshot(), now

    def _put(self, session: zenoh.Session, sends: list[Send]) -> None:
        for send in sends:
            session.put(keys.job(self._name, send.identity), self._batch(send), encoding=encoding(JobBatch))

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
        now = monotonic()
        if kind == "hello":
            self._hello(event, now)
        elif kind == "control":
            self._control(event)
        elif kind == "token":
            if event.kind == zenoh.SampleKind.DELETE:
                self._exchange.depart(keys.worker_of(str(event.key_expr)), now)
        elif kind == "result":
            results = self._inbox.decode(ResultBatch, event.payload.to_bytes())
            if results is not None and self._ours(results.run_uid):
                self._exchange.results(keys.worker_of(str(event.key_expr)), results, now)
        elif kind == "beat":
            beat = self._inbox.decode(Beat, event.payload.to_bytes())
            if beat is not None and self._ours(beat.run_uid) and beat.nonce == self._nonce:
                self._exchange.beat(keys.worker_of(str(event.key_expr)), beat, now)
        elif kind == "upload":
            part = self._inbox.decode(UploadPart, event.payload.to_bytes())
            if part is not None and self._ours(part.run_uid):
                self._exchange.upload(keys.worker_of(str(event.key_expr)), part, now)

    def _ours(self, run_uid: str) -> bool:
        if run_uid != self._run.uid:
            self._inbox.dropped["foreign run"] += 1
        return run_uid == self._run.uid

    def _hello(self, query: zenoh.Query, now: float) -> None:
        with query:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            request = self._inbox.decode_json(HelloRequest, payload)
            if request is None or not keys.is_worker(request.worker):
                reply = self._hello_reply("the request is not a hello", "update dreamfleet on the worker's host")
            elif not request.protocol_min <= keys.PROTOCOL_VERSION <= request.protocol_max:
                reply = self._hello_reply(
                    f"the worker speaks protocol {request.protocol_min} to {request.protocol_max}, this run "
                    f"{keys.PROTOCOL_VERSION}",
                    f"install dreamfleet {package_version('dreamfleet')} on the worker's host",
                )
            elif refusal := self._exchange.refusal(request, self._run.settings):
                reply = self._hello_reply(*refusal)
            else:
                self._exchange.admit(request, now)
                reply = self._hello_reply()
            query.reply(keys.hello(self._name), encode_json(reply), encoding="application/json")

    def _hello_reply(self, why: str = "", remedy: str = "") -> HelloReply:
        return HelloReply(
            accepted=not why,
            protocol_min=keys.PROTOCOL_VERSION,
            protocol_max=keys.PROTOCOL_VERSION,
            package=package_version("dreamfleet") or "unknown",
            run=self._name,
            run_uid=self._run.uid,
            incarnation=self._run.incarnation,
            nonce=self._nonce,
            why=why,
            remedy=remedy,
            spec={} if why else written(self._run.settings.task),
            intervals={} if why else asdict(self._intervals),
            packages=self._run.settings.packages,
        )

    def _control(self, query: zenoh.Query) -> None:
        verbs: dict[str, Callable[[], None]] = {
            "pause": lambda: self._run.pause("paused by hand"),
            "resume": self._resume,
            "drain": self._drain_run,
            "stop": self.stop,
        }
        with query:
            verb = str(query.key_expr).rsplit("/", 1)[-1]
            why = "" if verb in verbs else f"{verb!r} is no control verb of this version; it knows: {', '.join(verbs)}"
            if not why:
                verbs[verb]()
            reply = ControlReply(v=keys.PROTOCOL_VERSION, run=self._name, accepted=not why, why=why)
            query.reply(query.key_expr, encode_json(reply), encoding="application/json")

    def _resume(self) -> None:
        self._draining = False
        self._run.resume()

    def _drain_run(self) -> None:
        self._draining = True
        self._run.pause("draining")

    def _batch(self, send: Send) -> bytes:
        content = send.content
        return encode(
            JobBatch(
                run_uid=self._run.uid,
                incarnation=self._run.incarnation,
                nonce=self._nonce,
                number=send.number,
                vectors=tuple(content.vectors),
                jobs=tuple(work.job for work in content.work),
                cancels=tuple(content.cancels),
                verdicts=tuple(content.verdicts),
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
            log.info("generation %d: mean %.1f, best %.1f", closed.number, closed.mean, closed.best)
        evaluations = self._run.slack.evaluations
        if (last := evaluations.last) is not None and len(evaluations) > self._evaluations_told:
            log.info("evaluation of generation %d's mean: %.1f ± %.1f (standard error), %d episodes",
                     last.generation, last.mean, last.error, last.episodes)  # fmt: skip
        self._evaluations_told = len(evaluations)

    def _take_snapshot(self) -> Snapshot:
        now = monotonic()
        with self._lock:
            dropped = self._inbox.dropped + self._exchange.dropped + self._overflow
        return take_snapshot(self._run, self._name, dropped, now - self._started, now)

    def _answer_status(self, part: str) -> Callable[[zenoh.Query], None]:
        """An answer in the queryable's own thread: it reads the last snapshot and nothing else."""

        def answer(query: zenoh.Query) -> None:
            with query:
                payload = answers.answer(self._snapshot, part, query.parameters)
                query.reply(keys.status(self._name, part), payload, encoding="application/json")

        return answer

    @property
    def _bundles(self) -> tuple[str, ...]:
        """The world models that are served: one, or none where the task needs none."""
        sha256 = self._run.settings.task.bundle
        return (sha256,) if sha256 else ()

    def _answer_bundle(self, query: zenoh.Query) -> None:
        """In the queryable's own thread: reads a file that nobody writes."""
        with query:
            sha256 = self._run.settings.task.bundle
            asked = query.parameters
            try:
                offset, length = int(asked.get("offset") or 0), int(asked.get("length") or MAX_PART)
            except ValueError:
                query.reply_err(json.dumps({"why": "offset and length must be whole numbers"}).encode())
                return
            assert self._bundle is not None, "only what is served is asked for"
            offset, total, data = self._bundle.part(offset, length)
            part = BundlePart(
                run_uid=self._run.uid,
                incarnation=self._run.incarnation,
                sha256=bytes.fromhex(sha256),
                offset=offset,
                total=total,
                data=data,
            )
            query.reply(keys.bundle(self._name, sha256), encode(part), encoding=encoding(BundlePart))


def _callback(answer: Callable[[zenoh.Query], None]) -> Any:
    return zenoh.handlers.Callback(answer, indirect=False)
