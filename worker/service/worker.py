"""A worker: joins a run, scores what it is given, delivers until acknowledged.

Life: connect -> join -> fetch the bundle -> start slots -> serve -> leave. One owner thread, one queue; Zenoh
callbacks and slot readers only enqueue.
"""

from __future__ import annotations

import logging
import math
import os
import queue
import random
from contextlib import ExitStack, suppress
from time import monotonic
from typing import Any

import zenoh

from dreamfleet.common import keys
from dreamfleet.common.bundle import Bundle, BundleStore, default_cache
from dreamfleet.common.codec import Inbox, encode, encoding
from dreamfleet.common.errors import ConnectionFailedError, RefusedError
from dreamfleet.common.fingerprint import fingerprint
from dreamfleet.common.messages import MAX_LEASES, TAG_BYTES, Beat, JobBatch, Result, ResultBatch, Running, UploadPart
from dreamfleet.common.session import Network, enqueue_into, open_session
from dreamfleet.worker.service.admission import Admission, ask, make_request, neediest
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.bundle_fetch import obtain
from dreamfleet.worker.service.config import WorkerConfig
from dreamfleet.worker.service.outbox import Outbox
from dreamfleet.worker.service.slot import Slot, SlotEvent
from dreamfleet.worker.service.uploads import PACE, Uploads
from dreamfleet.worker.tasks.registry import find_task, known_tasks

log = logging.getLogger(__name__)
RETRY = 1.0  # seconds between attempts to connect or join
GONE = 5.0  # seconds without a coordinator after which a run counts as over
SILENT_BEATS = 5  # in which a coordinator that knows this worker would have answered
UPLOAD_GRACE = 30.0  # seconds more while a drive is on its way: no verdict is due before it is there
CLOCK_GAP = 2.0  # seconds between turns of the loop that mean a suspended host
SMOOTHING = 0.3  # weight of the newest interval in the throughput


class Worker:
    """One worker process."""

    def __init__(self, config: WorkerConfig, network: Network, tasks: tuple[str, ...] = ()) -> None:
        self.identity = keys.new_worker(config.name)
        self.inbox = Inbox()
        self._config = config
        self._network = network
        self._tasks = (*known_tasks(), *tasks)
        self._slot_count = config.slots or len(os.sched_getaffinity(0))
        self._events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._stops = 0
        self._slots: list[Slot] = []
        self._coordinators: set[str] = set()
        self._parted = False  # the joined coordinator was out of sight, and may have given this worker up
        self._quiet_since = self._ask_at = 0.0
        self._finished = self._steps_finished = 0

    def stop(self) -> None:
        """First: finish what runs and leave; second: leave now. Safe in a signal handler."""
        self._stops += 1
        self._events.put(("wake", None))

    def serve(self) -> None:
        """Work until told to stop, or until the run is over if so configured."""
        with ExitStack() as stack:
            session = self._connect()
            if session is None:
                return
            stack.callback(session.close)
            self._leave_at = monotonic() + (self._config.lifetime or math.inf)
            while (admission := self._join(session)) is not None:
                self._admission = admission
                self._serve_run(session)
                if self._stops or not self._config.any or monotonic() >= self._leave_at:
                    return

    def _serve_run(self, session: zenoh.Session) -> None:
        """Work for the joined run until it is over, or until this worker leaves."""
        admission = self._admission
        bundle = self._obtain_bundle(session)
        if bundle is None:
            return
        with ExitStack() as stack:
            stack.callback(self._stop_slots)
            self._slots = [
                Slot(number, admission.spec, bundle.path, self._events, self._config.slot_memory << 20)
                for number in range(self._slot_count)
            ]
            self._width = find_task(admission.spec.task).width
            self._backlog = Backlog(admission.spec)
            self._outbox = Outbox(admission.intervals.repeat)
            self._uploads = Uploads(admission.intervals.repeat)
            self._coordinators, self._parted = set(), False
            declared = self._declare(session)
            log.info("joined run %s as %s, %d slots", admission.run, self.identity, self._slot_count)
            self._loop(session)
            for each in declared:
                each.undeclare()
            log.info("leaving: %d jobs, %d environment steps", self._finished, self._steps_finished)

    def _connect(self) -> zenoh.Session | None:
        """A session, however long the router takes to come up; `None` if told to stop meanwhile."""
        said = False
        while not self._stops:
            try:
                return open_session(self._network, timeout=RETRY)
            except ConnectionFailedError:
                if not said:
                    log.warning("waiting for a coordinator at %s", ", ".join(self._network.connect))
                said = True
                self._pause()
        return None

    def _join(self, session: zenoh.Session) -> Admission | None:
        said = False
        request = make_request(self.identity, self._tasks, self._slot_count)
        while not self._stops:
            run = neediest(session) if self._config.any else self._config.run
            admission = ask(session, run, request, self.inbox) if run or not self._config.any else None
            if admission is not None:
                return admission
            if not said:
                log.warning("waiting for %s", f"run {self._config.run}" if self._config.run else "a run")
            said = True
            self._pause()
        return None

    def _obtain_bundle(self, session: zenoh.Session) -> Bundle | None:
        run, store = self._admission, BundleStore(default_cache())
        return obtain(session, run.run, run.spec.bundle, store, self.inbox, stopped=lambda: self._stops > 0)

    def _pause(self) -> None:
        """Wait a moment, with jitter, or until told to stop."""
        deadline = monotonic() + _jittered(RETRY)
        while not self._stops and (left := deadline - monotonic()) > 0:
            try:
                self._events.get(timeout=left)
            except queue.Empty:
                return

    def _declare(self, session: zenoh.Session) -> list[Any]:
        run = self._admission.run
        coordinators = keys.live_coordinator(run, "*")
        return [
            session.declare_subscriber(keys.job(run, self.identity), enqueue_into(self._events, "job")),
            session.liveliness().declare_subscriber(
                coordinators, enqueue_into(self._events, "coordinator"), history=True
            ),
            session.liveliness().declare_token(keys.live_worker(run, self.identity)),
        ]

    def _loop(self, session: zenoh.Session) -> None:
        self._quiet_since = now = monotonic()
        self._alone_since: float | None = now  # until a coordinator's token says otherwise
        self._beat_at, self._rate, self._counted = now, 0.0, (now, 0)
        drain_until = None
        while not self._left(drain_until):
            before = now
            self._wait()
            now = monotonic()
            gap = now - before if now - before > CLOCK_GAP else 0.0
            for slot in self._slots:
                slot.check(now, gap)
            if (self._stops or now >= self._leave_at) and drain_until is None:
                drain_until = now + self._config.drain_timeout
                self._hand_back()
                log.info("draining: running episodes finish, queued jobs go back")
            self._fill_slots()
            for results in self._outbox.due(now):
                self._send_results(session, results)
            if now >= self._beat_at:
                self._beat_at = now + self._admission.intervals.beat
                self._send_beat(session, now, capacity=0 if drain_until else self._capacity())
            self._send_uploads(session, now)  # after the beat, which says that the job is in these hands
            if self._must_rejoin(now):
                self._rejoin(session, now)

    def _hand_back(self) -> None:
        """Begin nothing more; the next beat shows what is no longer here."""
        self._backlog.clear()
        for slot in self._slots:
            for job in slot.waiting:
                slot.abandon(job.digest)

    def _left(self, drain_until: float | None) -> bool:
        if self._stops > 1:
            return True
        if drain_until is not None:
            busy = any(slot.running for slot in self._slots) or len(self._outbox)
            return not busy or monotonic() > drain_until
        alone = self._alone_since
        leaves = self._config.exit_when_done or self._config.any
        return leaves and alone is not None and monotonic() - alone > GONE

    def _wait(self) -> None:
        """Handle what has arrived, waiting until the next beat or repetition at most."""
        timeout = min(max(self._beat_at - monotonic(), 0.0), self._admission.intervals.repeat / 4)
        timeout = min(timeout, PACE) if len(self._uploads) else timeout
        try:
            self._handle(*self._events.get(timeout=timeout))
            while True:
                self._handle(*self._events.get_nowait())
        except queue.Empty:
            pass

    def _handle(self, kind: str, event: Any) -> None:
        if kind == "job":
            self._take_batch(event.payload.to_bytes())
        elif kind == "slot":
            self._take_slot_event(event)
        elif kind == "coordinator":
            self._take_token(event)

    def _take_token(self, event: zenoh.Sample) -> None:
        nonce = str(event.key_expr).rsplit("/", 1)[-1]
        if event.kind == zenoh.SampleKind.DELETE:
            self._coordinators.discard(nonce)
            self._parted |= nonce == self._admission.nonce
        else:
            self._coordinators.add(nonce)
        self._alone_since = None if self._coordinators else monotonic()

    def _take_batch(self, payload: bytes) -> None:
        batch = self.inbox.decode(JobBatch, payload)
        if batch is None:
            return
        if (batch.run_uid, batch.nonce) != (self._admission.run_uid, self._admission.nonce):
            self.inbox.dropped["foreign coordinator"] += 1
            return
        self._quiet_since = monotonic()
        for job, why in self._backlog.take_in(batch):
            self._outbox.add(Result(job.digest, None, 0, 0.0, why, None))
        judged = [verdict.digest for verdict in batch.verdicts]
        self._outbox.settle(judged)
        self._uploads.settle(judged)
        for slot in self._slots:
            for digest in batch.cancels:
                slot.abandon(digest)

    def _take_slot_event(self, event: SlotEvent) -> None:
        self._quiet_since = monotonic()
        if event.ready is not None:
            self._beat_at = 0.0  # new capacity is told at once
        results = self._slots[event.slot].handle(event)
        for result in results:
            self._finished += 1
            self._steps_finished += result.steps
            self._outbox.add(result)
        if results:
            if event.done is not None and event.done.upload is not None:
                self._uploads.add(results[0].digest, event.done.upload)
            self._fill_slots()  # before the other slots' events are looked at

    def _capacity(self) -> int:
        return min(sum(slot.ready for slot in self._slots) * self._width, MAX_LEASES // 2)

    def _fill_slots(self) -> None:
        if self._stops or monotonic() >= self._leave_at:
            return
        room = 4 * len(self._slots) * self._width - len(self._outbox)
        idle = [slot for slot in self._slots if slot.idle and room >= 0]
        ahead = [slot for slot in self._slots if slot.takes_more and room > 0]
        for slot in idle + ahead:
            if work := self._backlog.take(self._width):
                slot.submit(work)

    def _send_results(self, session: zenoh.Session, results: tuple[Result, ...]) -> None:
        run = self._admission
        batch = ResultBatch(
            run_uid=run.run_uid, incarnation=run.incarnation, fingerprint=fingerprint(), results=results
        )
        session.put(keys.result(run.run, self.identity), encode(batch), encoding=encoding(ResultBatch))

    def _send_uploads(self, session: zenoh.Session, now: float) -> None:
        run = self._admission
        for piece in self._uploads.due(now):
            part = UploadPart(
                run_uid=run.run_uid, incarnation=run.incarnation, digest=piece.digest, sha256=piece.sha256,
                offset=piece.offset, total=piece.total, data=piece.data,
            )  # fmt: skip
            session.put(keys.upload(run.run, self.identity), encode(part), encoding=encoding(UploadPart))

    def _send_beat(self, session: zenoh.Session, now: float, capacity: int) -> None:
        running = [
            Running(job.digest[:TAG_BYTES], slot.steps // len(slot.running))
            for slot in self._slots
            for job in slot.running
        ]
        queued = self._backlog.queued + [job.digest for slot in self._slots for job in slot.waiting]
        steps = self._steps_finished + sum(slot.steps for slot in self._slots)
        (then, before), self._counted = self._counted, (now, steps)
        if now > then:
            self._rate += SMOOTHING * (max(steps - before, 0) / (now - then) - self._rate)
        beat = Beat(
            run_uid=self._admission.run_uid,
            incarnation=self._admission.incarnation,
            nonce=self._admission.nonce,
            seen=self._backlog.seen,
            capacity=capacity,
            slots=len(self._slots),
            queued=_tags(queued),
            running=tuple(running[:MAX_LEASES]),
            unacked=_tags(self._outbox.digests),
            load=os.getloadavg()[0],
            steps_per_second=self._rate,
            drawn_by=next((slot.drawn_by for slot in self._slots if slot.ready), "-"),
        )
        session.put(keys.beat(self._admission.run, self.identity), encode(beat), encoding=encoding(Beat))

    def _must_rejoin(self, now: float) -> bool:
        """Whether the coordinator is in its next life, or may have forgotten this worker.

        A coordinator forgets whose token vanishes, and a cut of the connection makes each vanish for the other. The
        silence covers a loss that only the coordinator saw.
        """
        if not self._coordinators or now < self._ask_at:
            return False
        if self._parted or self._admission.nonce not in self._coordinators:
            return True
        idle = any(slot.ready for slot in self._slots) and not any(slot.running for slot in self._slots)
        patience = SILENT_BEATS * self._admission.intervals.beat + (UPLOAD_GRACE if len(self._uploads) else 0.0)
        silent = now - self._quiet_since > patience
        return silent and (idle or len(self._outbox) > 0)

    def _rejoin(self, session: zenoh.Session, now: float) -> None:
        """Say hello again; what runs goes on, what is unacknowledged is kept, what is queued is given again."""
        self._ask_at = now + _jittered(RETRY)
        request = make_request(self.identity, self._tasks, self._slot_count)
        admission = ask(session, self._admission.run, request, self.inbox)
        if admission is None:
            return
        if (admission.run_uid, admission.spec) != (self._admission.run_uid, self._admission.spec):
            raise RefusedError(f"run {admission.run} is another run now; start this worker again to join it")
        self._admission = admission
        self._drop_batches()
        self._backlog.begin()
        self._backlog.clear()
        self._outbox.resend_all()
        self._uploads.resend_all()
        self._parted, self._beat_at, self._quiet_since = False, 0.0, monotonic()
        log.info("joined run %s again, incarnation %d", admission.run, admission.incarnation)

    def _drop_batches(self) -> None:
        """Batches that wait in the queue are of the numbering that has ended, and would pass for later ones."""
        kept = []
        with suppress(queue.Empty):
            while True:
                kept.append(self._events.get_nowait())
        for kind, event in kept:
            if kind != "job":
                self._events.put((kind, event))

    def _stop_slots(self) -> None:
        for slot in self._slots:
            slot.stop()


def _jittered(seconds: float) -> float:
    return seconds * random.uniform(0.5, 1.5)  # noqa: S311 - no secret


def _tags(digests: list[bytes]) -> tuple[bytes, ...]:
    return tuple(digest[:TAG_BYTES] for digest in digests[:MAX_LEASES])
