"""A worker's time in one run: it takes jobs, has them scored, and delivers until each result has its verdict.

One owner thread and one queue; Zenoh's callbacks and the slots' readers only enqueue. What is decided lies in pure
parts (`Membership`, `Backlog`, `Outbox`, `UploadQueue`); here they meet the clock, the session and the slots.
"""

from __future__ import annotations

import logging
import queue
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from time import monotonic
from typing import Any

import zenoh

from dreamfleet.common.errors import RefusedError
from dreamfleet.common.host.error_counter import ErrorCounter
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder
from dreamfleet.common.protocol.messages import MAX_LEASES, JobBatch, Result
from dreamfleet.common.transport.session import enqueue_into
from dreamfleet.worker.service.admission import Admission
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.frame_publisher import FramePublisher
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.membership import COORDINATOR_GONE_AFTER, Membership, WorkerLoad
from dreamfleet.worker.service.outbox import Outbox
from dreamfleet.worker.service.sender import CoordinatorSender, StepRate
from dreamfleet.worker.service.slot import SlotEvent
from dreamfleet.worker.service.slot_pool import SlotPool
from dreamfleet.worker.service.upload_queue import BURST_INTERVAL, UploadQueue

log = logging.getLogger(__name__)
MAX_WAITING_BATCHES = 1024  # batches; a coordinator sends again what was not seen
CLOCK_GAP = 2.0  # seconds between turns of the loop that mean a suspended host

Events = queue.SimpleQueue[tuple[str, Any]]


@dataclass(frozen=True)
class CoordinatorLink:
    """How this worker reaches coordinators: its session and name, and what it decodes with."""

    session: zenoh.Session
    identity: str
    inbox: CountingDecoder
    # To a run by name, of a class that may not be known yet, by who is in the run of this uid; `None`: nobody answers.
    request_admission: Callable[[str, str, str], Admission | None]
    retry_delay: Callable[[], float]  # seconds until hello may be said again


class RunSession:
    """The run that this worker has joined; `serve` returns when the worker leaves it."""

    def __init__(
        self, link: CoordinatorLink, admission: Admission, membership: Membership, slots: SlotPool, events: Events
    ) -> None:
        self._link = link
        self._admission = admission
        self._membership = membership
        self._slots = slots
        self._events = events
        self._sender = CoordinatorSender(link.session, link.identity, admission)
        self._backlog = Backlog(admission.spec)
        self._backlog.start_numbering(admission.numbering)
        self._outbox = Outbox(admission.intervals.repeat)
        self._uploads = UploadQueue(admission.intervals.repeat)
        self._rate = StepRate(monotonic())
        self._error_counter = ErrorCounter(log)
        self._next_heartbeat_at = 0.0
        self._finished = self._steps_finished = 0

    def serve(self) -> None:
        """Work until told to leave, or until the run is over; ends neither the slots nor the session."""
        declared = self._startup()
        try:
            self._main_loop()
        finally:
            self._shutdown(declared)

    def _startup(self) -> list[Any]:
        run, session = self._admission.run, self._link.session
        self._membership.join(self._admission.nonce, self._admission.intervals.beat, monotonic())
        coordinators = keys.live_coordinator(run, "*")
        self._frame_publisher = FramePublisher(session, run, self._link.identity, enqueue_into(self._events, "viewers"))
        declared = [
            session.declare_subscriber(
                keys.job(run, self._link.identity), enqueue_into(self._events, "job", MAX_WAITING_BATCHES)
            ),
            session.liveliness().declare_subscriber(
                coordinators, enqueue_into(self._events, "coordinator"), history=True
            ),
            session.liveliness().declare_token(keys.live_worker(run, self._link.identity)),
            self._frame_publisher,
        ]
        log.info("joined run %s as %s, %d slots", run, self._link.identity, len(self._slots))
        return declared

    def _main_loop(self) -> None:
        now = monotonic()
        while not self._membership.is_over(now, busy=self._slots.busy or len(self._outbox) > 0):
            before = now
            self._wait()
            now = monotonic()
            self._slots.check(now, gap=now - before if now - before > CLOCK_GAP else 0.0)
            if self._membership.start_draining_if_due(now):
                self._return_unstarted_jobs()
                log.info("draining: running episodes finish, queued jobs go back")
            self._fill_slots(now)
            self._send(now)
            if self._membership.must_rejoin(now, self._load()):
                self._rejoin(now)

    def _shutdown(self, declared: list[Any]) -> None:
        self._send_heartbeat(monotonic(), capacity=0)  # tells its end from that of a worker that was killed
        for each in declared:
            each.undeclare()
        log.info(
            "leaving run %s: %d jobs, %d environment steps", self._admission.run, self._finished, self._steps_finished
        )

    def _wait(self) -> None:
        """Handle what has arrived, waiting until the next beat or repetition at most."""
        timeout = min(max(self._next_heartbeat_at - monotonic(), 0.0), self._admission.intervals.repeat / 4)
        timeout = min(timeout, BURST_INTERVAL) if len(self._uploads) else timeout
        with suppress(queue.Empty):
            self._handle(*self._events.get(timeout=timeout))
            while True:
                self._handle(*self._events.get_nowait())

    def _handle(self, kind: str, event: Any) -> None:
        """One event. No message of a coordinator ends a worker: what raises costs that message, which is sent again.

        What a slot says is our own affair: a slot that cannot start ends the worker.
        """
        if kind == "slot" and isinstance(event.message, SampledFrame):
            self._publish_frame(event, event.message)
            return
        if kind == "slot":
            self._handle_slot_event(event)
            return
        try:
            if kind == "job":
                self._handle_batch(event.payload.to_bytes())
            elif kind == "coordinator":
                self._handle_coordinator_token(event)
            elif kind == "viewers":
                self._slots.show(event.matching)
        except Exception as error:
            self._error_counter.record(kind, error, event)

    def _handle_coordinator_token(self, event: zenoh.Sample) -> None:
        nonce = str(event.key_expr).rsplit("/", 1)[-1]
        if event.kind == zenoh.SampleKind.DELETE:
            self._membership.remove_coordinator(nonce, monotonic())
            then = (
                f"this worker leaves too if it is not back within {COORDINATOR_GONE_AFTER:g} s"
                if self._membership.leaves_without_coordinator
                else "this worker waits for that run alone (--any: the next one)"
            )
            log.info("the coordinator of run %s is out of sight: it left, or the connection was cut; %s",
                     self._admission.run, then,
                     extra={"facts": {"event": "coordinator gone", "run": self._admission.run}})  # fmt: skip
        elif self._membership.add_coordinator(nonce):  # of another life the new welcome is told
            log.info("the coordinator of run %s is in sight again; this worker goes on", self._admission.run,
                     extra={"facts": {"event": "coordinator back", "run": self._admission.run}})  # fmt: skip

    def _handle_batch(self, payload: bytes) -> None:
        batch = self._link.inbox.decode(JobBatch, payload)
        if batch is None:
            return
        ours = self._admission
        if (batch.run_uid, batch.incarnation, batch.nonce) != (ours.run_uid, ours.incarnation, ours.nonce):
            self._link.inbox.dropped["foreign coordinator"] += 1
            return
        if batch.numbering < self._backlog.numbering:  # what it says was said again since
            self._link.inbox.dropped["earlier numbering"] += 1
            return
        if batch.numbering > self._backlog.numbering:  # it was welcomed again or given up, unheard; or so anybody says
            self._link.inbox.dropped["unheard numbering"] += 1
            self._membership.suspect_forgotten()
            return
        self._membership.note_activity(monotonic())
        if batch.leave:
            self._membership.end_run()
        for digest in batch.cancels:
            self._slots.abandon(digest)
        for job, why in self._backlog.add_batch(batch, self._slots.wanted_digests):
            if len(self._outbox) < MAX_LEASES:  # more than a beat can name nobody waits for
                self._outbox.add(Result(job.digest, None, 0, 0.0, why, None))
        judged = [verdict.digest for verdict in batch.verdicts]
        self._outbox.acknowledge(judged)
        self._uploads.acknowledge(judged)
        if self._membership.draining:  # jobs that were on their way: the next beat shows that they are not here
            self._backlog.clear()

    def _handle_slot_event(self, event: SlotEvent) -> None:
        now = monotonic()
        self._membership.note_activity(now)
        capacity = self._slots.capacity
        results = self._slots.handle(event)
        if self._slots.capacity > capacity:
            self._next_heartbeat_at = 0.0  # new capacity is told at once
        for result in results:
            self._finished += 1
            self._steps_finished += result.steps
            self._outbox.add(result)
        if results:
            if event.upload is not None:
                self._uploads.add(results[0].digest, event.upload)
            self._fill_slots(now)  # before the other slots' events are looked at

    def _publish_frame(self, event: SlotEvent, frame: SampledFrame) -> None:
        """Publish a frame. It is no news that the coordinator owes an answer to, so its silence goes on."""
        work = self._slots.find_job(event.slot, event.child_number, frame)
        if work is not None:
            self._frame_publisher.show(self._admission, event.slot, work, frame)

    def _fill_slots(self, now: float) -> None:
        if not self._membership.is_leaving(now):
            self._slots.fill(self._backlog, undelivered=len(self._outbox))

    def _return_unstarted_jobs(self) -> None:
        """Begin nothing more; the next beat shows what is no longer here."""
        self._backlog.clear()
        self._slots.abandon_waiting()

    def _send(self, now: float) -> None:
        if (
            now >= self._next_heartbeat_at
        ):  # first, so that a coordinator that has just welcomed it listens to what follows
            self._next_heartbeat_at = now + self._admission.intervals.beat
            self._send_heartbeat(now, capacity=0 if self._membership.draining else self._slots.capacity)
        for results in self._outbox.due(now):
            self._sender.results(self._slots, results)
        for piece in self._uploads.due(now):  # after the beat, which says that the job is in these hands
            self._sender.upload(piece)

    def _send_heartbeat(self, now: float, capacity: int) -> None:
        self._sender.beat(
            self._slots,
            numbering=self._backlog.numbering,
            seen=self._backlog.seen,
            capacity=capacity,
            queued=self._backlog.queued,
            unacked=self._outbox.digests,
            rate=self._rate.update(now, self._steps_finished + self._slots.steps),
        )

    def _load(self) -> WorkerLoad:
        return WorkerLoad(idle=self._slots.idle, awaits_verdict=len(self._outbox) > 0, uploading=len(self._uploads) > 0)

    def _rejoin(self, now: float) -> None:
        """Say hello again; what runs goes on, what is unacknowledged is kept, what is queued is given again."""
        self._membership.note_hello_sent(now, self._link.retry_delay())
        admission = self._link.request_admission(self._admission.run, self._slots.host_class, self._admission.run_uid)
        if admission is None:
            return
        if (admission.run_uid, admission.spec) != (self._admission.run_uid, self._admission.spec):
            raise RefusedError(f"run {admission.run} is another run now")
        anew = admission.nonce != self._admission.nonce
        self._admission = admission
        self._sender = CoordinatorSender(self._link.session, self._link.identity, admission)
        if anew or admission.numbering != self._backlog.numbering:
            self._restart_numbering(admission.numbering)
        self._membership.rejoin(admission.nonce, monotonic())
        level = logging.INFO if anew else logging.DEBUG  # an idle worker of a paused run asks again and again
        log.log(level, "joined run %s again, incarnation %d", admission.run, admission.incarnation)

    def _restart_numbering(self, numbering: int) -> None:
        """What was given under the last one is given again; what is unacknowledged is said again."""
        self._backlog.start_numbering(numbering)
        self._backlog.clear()
        self._outbox.resend_all()
        self._uploads.resend_all()
        self._next_heartbeat_at = 0.0
