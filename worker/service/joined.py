"""A worker's time in one run: it takes jobs, has them scored, and delivers until each result has its verdict.

One owner thread and one queue; Zenoh's callbacks and the slots' readers only enqueue. What is decided lies in pure
parts (`Membership`, `Backlog`, `Outbox`, `Uploads`); here they meet the clock, the session and the slots.
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

from dreamfleet.common import keys
from dreamfleet.common.codec import Inbox
from dreamfleet.common.errors import RefusedError
from dreamfleet.common.messages import MAX_LEASES, JobBatch, Result
from dreamfleet.common.mishaps import Mishaps
from dreamfleet.common.session import enqueue_into
from dreamfleet.worker.service.admission import Admission
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.glimpses import Seen
from dreamfleet.worker.service.membership import GONE, Hands, Membership
from dreamfleet.worker.service.outbox import Outbox
from dreamfleet.worker.service.post import Post, Rate
from dreamfleet.worker.service.slot import SlotEvent
from dreamfleet.worker.service.slots import Slots
from dreamfleet.worker.service.uploads import PACE, Uploads
from dreamfleet.worker.service.viewing import Viewing

log = logging.getLogger(__name__)
MOST_WAITING = 1024  # batches; a coordinator sends again what was not seen
CLOCK_GAP = 2.0  # seconds between turns of the loop that mean a suspended host

Events = queue.SimpleQueue[tuple[str, Any]]


@dataclass(frozen=True)
class Line:
    """How this worker reaches coordinators: its session and name, and what it decodes with."""

    session: zenoh.Session
    identity: str
    inbox: Inbox
    # To a run by name, of a class that may not be known yet, by who is in the run of this uid; `None`: nobody answers.
    say_hello: Callable[[str, str, str], Admission | None]
    pause: Callable[[], float]  # seconds until hello may be said again


class JoinedRun:
    """The run that this worker has joined; `serve` returns when the worker leaves it."""

    def __init__(self, line: Line, admission: Admission, membership: Membership, slots: Slots, events: Events) -> None:
        self._line = line
        self._admission = admission
        self._membership = membership
        self._slots = slots
        self._events = events
        self._post = Post(line.session, line.identity, admission)
        self._backlog = Backlog(admission.spec)
        self._backlog.begin(admission.numbering)
        self._outbox = Outbox(admission.intervals.repeat)
        self._uploads = Uploads(admission.intervals.repeat)
        self._rate = Rate(monotonic())
        self._mishaps = Mishaps(log)
        self._beat_at = 0.0
        self._finished = self._steps_finished = 0

    def serve(self) -> None:
        """Work until told to leave, or until the run is over; ends neither the slots nor the session."""
        declared = self._startup()
        try:
            self._main_loop()
        finally:
            self._shutdown(declared)

    def _startup(self) -> list[Any]:
        run, session = self._admission.run, self._line.session
        self._membership.join(self._admission.nonce, self._admission.intervals.beat, monotonic())
        coordinators = keys.live_coordinator(run, "*")
        self._viewing = Viewing(session, run, self._line.identity, enqueue_into(self._events, "viewers"))
        declared = [
            session.declare_subscriber(
                keys.job(run, self._line.identity), enqueue_into(self._events, "job", MOST_WAITING)
            ),
            session.liveliness().declare_subscriber(
                coordinators, enqueue_into(self._events, "coordinator"), history=True
            ),
            session.liveliness().declare_token(keys.live_worker(run, self._line.identity)),
            self._viewing,
        ]
        log.info("joined run %s as %s, %d slots", run, self._line.identity, len(self._slots))
        return declared

    def _main_loop(self) -> None:
        now = monotonic()
        while not self._membership.over(now, busy=self._slots.busy or len(self._outbox) > 0):
            before = now
            self._wait()
            now = monotonic()
            self._slots.check(now, gap=now - before if now - before > CLOCK_GAP else 0.0)
            if self._membership.must_drain(now):
                self._hand_back()
                log.info("draining: running episodes finish, queued jobs go back")
            self._fill_slots(now)
            self._send(now)
            if self._membership.must_rejoin(now, self._hands()):
                self._rejoin(now)

    def _shutdown(self, declared: list[Any]) -> None:
        self._beat(monotonic(), capacity=0)  # tells its end from that of a worker that was killed
        for each in declared:
            each.undeclare()
        log.info(
            "leaving run %s: %d jobs, %d environment steps", self._admission.run, self._finished, self._steps_finished
        )

    def _wait(self) -> None:
        """Handle what has arrived, waiting until the next beat or repetition at most."""
        timeout = min(max(self._beat_at - monotonic(), 0.0), self._admission.intervals.repeat / 4)
        timeout = min(timeout, PACE) if len(self._uploads) else timeout
        with suppress(queue.Empty):
            self._handle(*self._events.get(timeout=timeout))
            while True:
                self._handle(*self._events.get_nowait())

    def _handle(self, kind: str, event: Any) -> None:
        """One event. No message of a coordinator ends a worker: what raises costs that message, which is sent again.

        What a slot says is our own affair: a slot that cannot start ends the worker.
        """
        if kind == "slot" and isinstance(event.word, Seen):
            self._show(event, event.word)
            return
        if kind == "slot":
            self._take_slot_event(event)
            return
        try:
            if kind == "job":
                self._take_batch(event.payload.to_bytes())
            elif kind == "coordinator":
                self._take_token(event)
            elif kind == "viewers":
                self._slots.show(event.matching)
        except Exception as error:
            self._mishaps.note(kind, error, event)

    def _take_token(self, event: zenoh.Sample) -> None:
        nonce = str(event.key_expr).rsplit("/", 1)[-1]
        if event.kind == zenoh.SampleKind.DELETE:
            self._membership.vanish(nonce, monotonic())
            then = (
                f"this worker leaves too if it is not back within {GONE:g} s"
                if self._membership.leaves_alone
                else "this worker waits for that run alone (--any: the next one)"
            )
            log.info("the coordinator of run %s is out of sight: it left, or the connection was cut; %s",
                     self._admission.run, then,
                     extra={"facts": {"event": "coordinator gone", "run": self._admission.run}})  # fmt: skip
        elif self._membership.appear(nonce):  # of another life the new welcome is told
            log.info("the coordinator of run %s is in sight again; this worker goes on", self._admission.run,
                     extra={"facts": {"event": "coordinator back", "run": self._admission.run}})  # fmt: skip

    def _take_batch(self, payload: bytes) -> None:
        batch = self._line.inbox.decode(JobBatch, payload)
        if batch is None:
            return
        ours = self._admission
        if (batch.run_uid, batch.incarnation, batch.nonce) != (ours.run_uid, ours.incarnation, ours.nonce):
            self._line.inbox.dropped["foreign coordinator"] += 1
            return
        if batch.numbering < self._backlog.numbering:  # what it says was said again since
            self._line.inbox.dropped["earlier numbering"] += 1
            return
        if batch.numbering > self._backlog.numbering:  # it was welcomed again or given up, unheard; or so anybody says
            self._line.inbox.dropped["unheard numbering"] += 1
            self._membership.doubt()
            return
        self._membership.hear(monotonic())
        if batch.leave:
            self._membership.disband()
        for digest in batch.cancels:
            self._slots.abandon(digest)
        for job, why in self._backlog.take_in(batch, self._slots.held):
            if len(self._outbox) < MAX_LEASES:  # more than a beat can name nobody waits for
                self._outbox.add(Result(job.digest, None, 0, 0.0, why, None))
        judged = [verdict.digest for verdict in batch.verdicts]
        self._outbox.settle(judged)
        self._uploads.settle(judged)
        if self._membership.draining:  # jobs that were on their way: the next beat shows that they are not here
            self._backlog.clear()

    def _take_slot_event(self, event: SlotEvent) -> None:
        now = monotonic()
        self._membership.hear(now)
        capacity = self._slots.capacity
        results = self._slots.handle(event)
        if self._slots.capacity > capacity:
            self._beat_at = 0.0  # new capacity is told at once
        for result in results:
            self._finished += 1
            self._steps_finished += result.steps
            self._outbox.add(result)
        if results:
            if event.upload is not None:
                self._uploads.add(results[0].digest, event.upload)
            self._fill_slots(now)  # before the other slots' events are looked at

    def _show(self, event: SlotEvent, seen: Seen) -> None:
        """Publish a frame. It is no news that the coordinator owes an answer to, so its silence goes on."""
        work = self._slots.work_of(event.slot, event.life, seen)
        if work is not None:
            self._viewing.show(self._admission, event.slot, work, seen)

    def _fill_slots(self, now: float) -> None:
        if not self._membership.leaving(now):
            self._slots.fill(self._backlog, undelivered=len(self._outbox))

    def _hand_back(self) -> None:
        """Begin nothing more; the next beat shows what is no longer here."""
        self._backlog.clear()
        self._slots.hand_back()

    def _send(self, now: float) -> None:
        if now >= self._beat_at:  # first, so that a coordinator that has just welcomed it listens to what follows
            self._beat_at = now + self._admission.intervals.beat
            self._beat(now, capacity=0 if self._membership.draining else self._slots.capacity)
        for results in self._outbox.due(now):
            self._post.results(self._slots, results)
        for piece in self._uploads.due(now):  # after the beat, which says that the job is in these hands
            self._post.upload(piece)

    def _beat(self, now: float, capacity: int) -> None:
        self._post.beat(
            self._slots,
            numbering=self._backlog.numbering,
            seen=self._backlog.seen,
            capacity=capacity,
            queued=self._backlog.queued,
            unacked=self._outbox.digests,
            rate=self._rate.read(now, self._steps_finished + self._slots.steps),
        )

    def _hands(self) -> Hands:
        return Hands(idle=self._slots.idle, owed=len(self._outbox) > 0, uploading=len(self._uploads) > 0)

    def _rejoin(self, now: float) -> None:
        """Say hello again; what runs goes on, what is unacknowledged is kept, what is queued is given again."""
        self._membership.ask(now, self._line.pause())
        admission = self._line.say_hello(self._admission.run, self._slots.host_class, self._admission.run_uid)
        if admission is None:
            return
        if (admission.run_uid, admission.spec) != (self._admission.run_uid, self._admission.spec):
            raise RefusedError(f"run {admission.run} is another run now")
        anew = admission.nonce != self._admission.nonce
        self._admission = admission
        self._post = Post(self._line.session, self._line.identity, admission)
        if anew or admission.numbering != self._backlog.numbering:
            self._begin_numbering(admission.numbering)
        self._membership.rejoin(admission.nonce, monotonic())
        level = logging.INFO if anew else logging.DEBUG  # an idle worker of a paused run asks again and again
        log.log(level, "joined run %s again, incarnation %d", admission.run, admission.incarnation)

    def _begin_numbering(self, numbering: int) -> None:
        """What was given under the last one is given again; what is unacknowledged is said again."""
        self._backlog.begin(numbering)
        self._backlog.clear()
        self._outbox.resend_all()
        self._uploads.resend_all()
        self._beat_at = 0.0
