"""Simulated workers: the whole protocol and no scoring, many in one process, to load a real coordinator."""

from __future__ import annotations

import queue
import time
from dataclasses import dataclass, field
from typing import Any

import zenoh

from dreamfleet.common import keys
from dreamfleet.common.codec import Inbox, encode, encoding
from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.fingerprint import fingerprint
from dreamfleet.common.messages import MAX_LEASES, TAG_BYTES, Beat, JobBatch, Result, ResultBatch
from dreamfleet.common.session import Network, enqueue_into, open_session
from dreamfleet.worker.bench.naps import NULLS
from dreamfleet.worker.service.admission import Admission, ask, make_request
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.outbox import Outbox


@dataclass
class Simulated:
    """One worker: its jobs end as they come."""

    identity: str
    admission: Admission
    slots: int
    backlog: Backlog = field(init=False)
    outbox: Outbox = field(init=False)
    beat_at: float = 0.0

    def __post_init__(self) -> None:
        self.backlog = Backlog(self.admission.spec)
        self.backlog.begin(self.admission.numbering)
        self.outbox = Outbox(self.admission.intervals.repeat)

    def take(self, batch: JobBatch) -> None:
        """Finish every job of a batch."""
        self.backlog.take_in(batch)
        self.outbox.settle(verdict.digest for verdict in batch.verdicts)
        for job, _ in self.backlog.take(MAX_LEASES):
            self.outbox.add(Result(job.digest, float(job.seeds[0] % 1000), 1, 0.0, None, None))

    def beat(self) -> Beat:
        """What it holds: nothing but results without a verdict."""
        run = self.admission
        return Beat(
            run_uid=run.run_uid, incarnation=run.incarnation, nonce=run.nonce,
            numbering=self.backlog.numbering, seen=self.backlog.seen, capacity=self.slots, slots=self.slots, queued=(),
            running=(),
            unacked=tuple(digest[:TAG_BYTES] for digest in self.outbox.digests), load=0.0, steps_per_second=0.0,
            drawn_by="-",
        )  # fmt: skip


def serve_crowd(endpoint: str, count: int, slots: int) -> None:
    """Join as `count` workers and work until killed."""
    session, inbox = _connect(endpoint), Inbox()
    events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
    crowd: dict[str, Simulated] = {}
    kept: list[Any] = []
    for number in range(count):
        identity = keys.new_worker(f"crowd-{number}")
        request = make_request(identity, (NULLS,), slots)
        while (admission := ask(session, None, request, inbox)) is None:
            time.sleep(0.1)
        crowd[identity] = Simulated(identity, admission, slots)
        kept.append(session.declare_subscriber(keys.job(admission.run, identity), enqueue_into(events, "job")))
        kept.append(session.liveliness().declare_token(keys.live_worker(admission.run, identity)))
        _work(session, crowd, events, inbox, wait=0.0)
    while True:
        _work(session, crowd, events, inbox, wait=0.02)


def _connect(endpoint: str) -> zenoh.Session:
    while True:
        try:
            return open_session(Network(connect=(endpoint,)), timeout=1.0)
        except ConnectionFailedError:
            time.sleep(0.1)


def _work(
    session: zenoh.Session,
    crowd: dict[str, Simulated],
    events: queue.SimpleQueue[tuple[str, Any]],
    inbox: Inbox,
    wait: float,
) -> None:
    """Handle what has come, send results and beats that are due."""
    stirred: set[str] = set()
    try:
        _, sample = events.get(timeout=wait) if wait else events.get_nowait()
        while True:
            batch = inbox.decode(JobBatch, sample.payload.to_bytes())
            identity = keys.worker_of(str(sample.key_expr))
            if batch is not None and identity in crowd:
                crowd[identity].take(batch)
                stirred.add(identity)
            _, sample = events.get_nowait()
    except queue.Empty:
        pass
    now = time.monotonic()
    for identity, worker in crowd.items():
        run = worker.admission
        if now >= worker.beat_at:
            worker.beat_at = now + run.intervals.beat
            stirred.add(identity)
            session.put(keys.beat(run.run, identity), encode(worker.beat()), encoding=encoding(Beat))
        if identity not in stirred:
            continue
        for results in worker.outbox.due(now):
            message = ResultBatch(
                run_uid=run.run_uid, incarnation=run.incarnation, fingerprint=fingerprint(run.packages), results=results
            )
            session.put(keys.result(run.run, identity), encode(message), encoding=encoding(ResultBatch))
