"""Simulated workers: the whole protocol without scoring, many in one process, to load a real coordinator."""

import queue
import time
from collections import deque
from dataclasses import dataclass, field
from math import inf
from typing import Any

import zenoh

from dreamfleet.common.errors import ConnectionFailedError
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder, encode, encoding
from dreamfleet.common.protocol.messages import (
    MAX_LEASES,
    TAG_BYTES,
    Heartbeat,
    JobBatch,
    Result,
    ResultBatch,
    RunningJob,
)
from dreamfleet.common.transport.session import Network, enqueue_into, open_session
from dreamfleet.worker.addons.bench.sleep_tasks import NULL_TASK
from dreamfleet.worker.service.admission import Admission, CoordinatorLink, make_request
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.outbox import Outbox

LONGEST_WAIT = 0.02  # seconds between two looks at what is due


@dataclass
class SimulatedWorker:
    """One simulated worker; each of its slots holds a job for so many `seconds`, with 0 all jobs end as they arrive."""

    identity: str
    admission: Admission
    slots: int
    seconds: float
    backlog: Backlog = field(init=False)
    outbox: Outbox = field(init=False)
    running: deque[tuple[float, Result]] = field(init=False, default_factory=deque)  # with the moment of its end
    beat_at: float = 0.0

    def __post_init__(self) -> None:
        self.backlog = Backlog(self.admission.spec)
        self.backlog.start_numbering(self.admission.numbering)
        self.outbox = Outbox(self.admission.intervals.repeat)

    def take(self, batch: JobBatch) -> None:
        """Queue the jobs of a batch."""
        self.backlog.add_batch(batch, {result.digest for _, result in self.running})
        self.outbox.acknowledge(verdict.digest for verdict in batch.verdicts)

    def work(self, now: float) -> bool:
        """Finish what is done and begin what is queued; return whether a result is new."""
        finished = 0
        while self.running and self.running[0][0] <= now:
            self.outbox.add(self.running.popleft()[1])
            finished += 1
        room = self.slots - len(self.running) if self.seconds else MAX_LEASES
        for job, _ in self.backlog.take(room) if room else ():
            result = Result(job.digest, float(job.seeds[0] % 1000), 1, self.seconds, None, None)
            if self.seconds:
                self.running.append((now + self.seconds, result))
            else:
                self.outbox.add(result)
                finished += 1
        return finished > 0

    def beat(self) -> Heartbeat:
        """Return its heartbeat: what it has, and results not acknowledged yet."""
        run = self.admission
        return Heartbeat(
            run_uid=run.run_uid, incarnation=run.incarnation, nonce=run.nonce,
            numbering=self.backlog.numbering, seen=self.backlog.seen, capacity=self.slots, slots=self.slots,
            queued=tuple(digest[:TAG_BYTES] for digest in self.backlog.queued),
            running=tuple(RunningJob(result.digest[:TAG_BYTES], 0) for _, result in self.running),
            unacked=tuple(digest[:TAG_BYTES] for digest in self.outbox.digests[:MAX_LEASES]),
            load=0.0, steps_per_second=0.0, drawn_by="-",
        )  # fmt: skip


def run_simulated_workers(_pipe: object, endpoint: str, count: int, slots: int, seconds: float) -> None:
    """Join the coordinator at `endpoint` as `count` workers of `slots` slots, and work until killed.

    A job takes so many `seconds` of a slot, and nothing of a processor.
    """
    session, inbox = _connect(endpoint), CountingDecoder()
    events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
    crowd: dict[str, SimulatedWorker] = {}
    declarations: list[Any] = []
    for number in range(count):
        identity = keys.new_worker_identity(f"crowd-{number}")
        link = CoordinatorLink(session, make_request(identity, (NULL_TASK,), slots), inbox)
        while (admission := link.request_admission(None)) is None:
            time.sleep(0.1)
        crowd[identity] = SimulatedWorker(identity, admission, slots, seconds)
        declarations.append(session.declare_subscriber(keys.job(admission.run, identity), enqueue_into(events, "job")))
        declarations.append(session.liveliness().declare_token(keys.live_worker(admission.run, identity)))
        _handle_and_send(session, crowd, events, inbox, wait=0.0)
    while True:
        ends = min((worker.running[0][0] for worker in crowd.values() if worker.running), default=inf)
        _handle_and_send(session, crowd, events, inbox, wait=min(max(ends - time.monotonic(), 0.0), LONGEST_WAIT))


def _connect(endpoint: str) -> zenoh.Session:
    while True:
        try:
            return open_session(Network(connect=(endpoint,)), timeout=1.0)
        except ConnectionFailedError:
            time.sleep(0.1)


def _handle_and_send(
    session: zenoh.Session,
    crowd: dict[str, SimulatedWorker],
    events: queue.SimpleQueue[tuple[str, Any]],
    inbox: CountingDecoder,
    wait: float,
) -> None:
    try:
        _, sample = events.get(timeout=wait) if wait else events.get_nowait()
        while True:
            batch = inbox.decode(JobBatch, sample.payload.to_bytes())
            identity = keys.worker_from_key(str(sample.key_expr))
            if batch is not None and identity in crowd:
                crowd[identity].take(batch)
            _, sample = events.get_nowait()
    except queue.Empty:
        pass
    now = time.monotonic()
    for identity, worker in crowd.items():
        run, is_due, is_active = worker.admission, now >= worker.beat_at, worker.work(now)
        if is_due:
            worker.beat_at = now + run.intervals.beat
            session.put(keys.heartbeat(run.run, identity), encode(worker.beat()), encoding=encoding(Heartbeat))
        for results in worker.outbox.due(now) if is_due or is_active else ():
            message = ResultBatch(
                run_uid=run.run_uid, incarnation=run.incarnation, fingerprint=fingerprint(run.packages), results=results
            )
            session.put(keys.result(run.run, identity), encode(message), encoding=encoding(ResultBatch))
