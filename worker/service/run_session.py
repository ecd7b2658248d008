"""A worker in one run: it receives jobs, has them scored, and delivers each result until it has a verdict.

One thread owns everything and reads one queue; Zenoh's callbacks and the slots' readers only enqueue. The decisions are
in pure classes (`Membership`, `Backlog`, `Outbox`, `UploadQueue`). This module gives them times and events.
"""

import logging
import queue
import random
from contextlib import suppress
from time import monotonic
from typing import Any

import zenoh

from dreamfleet.common.errors import ConnectionFailedError, RefusedError
from dreamfleet.common.host.error_counter import ErrorCounter
from dreamfleet.common.host.logs import log_event
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.printable import one_line, plural
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.messages import MAX_LEASES, JobBatch, Result
from dreamfleet.common.transport.session import enqueue_into
from dreamfleet.worker.service.admission import Admission, CoordinatorLink, find_names_of_run
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.frame_publisher import FramePublisher
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.membership import Membership, WorkerLoad
from dreamfleet.worker.service.outbox import BURST_INTERVAL, Outbox, UploadQueue
from dreamfleet.worker.service.sender import CoordinatorSender, StepRate
from dreamfleet.worker.service.slot import SlotEvent
from dreamfleet.worker.service.slot_pool import BATCH_INTERVAL, SlotPool
from dreamfleet.worker.service.wording import describe_failure

log = logging.getLogger(__name__)
MAX_WAITING_BATCHES = 1024  # R26: more batches are dropped unread; the coordinator sends unconfirmed ones again
RETRY = 1.0  # seconds between two hellos, about
CLOCK_GAP = 2.0  # seconds between two passes of the loop that mean that the host was suspended; as dispatch/fleet.py

Events = queue.SimpleQueue[tuple[str, Any]]


class RunSession:
    """This worker in the run that it has joined; `serve` returns when it leaves."""

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
        self._said_waiting = self._said_shut_out = False
        self._coordinator_version = package_version("dreamfleet")

    @property
    def run(self) -> str:
        """The run's name now."""
        return self._admission.run

    def serve(self) -> None:
        """Work until this worker stops or the run is over. Closes neither the slots nor the session.

        `ConnectionFailedError` if it gave the run up because its coordinator was out of sight for too long.
        """
        self._startup()
        try:
            why = self._main_loop()
        except BaseException as error:
            self._shutdown(describe_failure(error))
            raise
        self._shutdown(why)
        if self._membership.gives_up(monotonic()):
            raise ConnectionFailedError(
                f"left run {self._admission.run}: {why}{self._lost_results()}; start this worker again, or give it "
                "more --coordinator-timeout"
            )

    def _startup(self) -> None:
        run, session = self._admission.run, self._link.session
        self._membership.join(self._admission.nonce, self._admission.intervals.beat, monotonic())
        coordinators = keys.live_coordinator(run, "*")
        self._frame_publisher = FramePublisher(session, run, self._link.identity, enqueue_into(self._events, "viewers"))
        self._declared: list[Any] = [
            session.declare_subscriber(
                keys.job(run, self._link.identity), enqueue_into(self._events, "job", MAX_WAITING_BATCHES)
            ),
            session.liveliness().declare_subscriber(
                coordinators, enqueue_into(self._events, "coordinator"), history=True
            ),
            session.liveliness().declare_token(keys.live_worker(run, self._link.identity)),
            self._frame_publisher,
        ]
        device = f", dreams on {self._slots.torch_device}" if self._slots.torch_device else ""  # docs/how-to/gpu.md
        text = f"joined run {run} as {self._link.identity}, {plural(len(self._slots), 'slot')}{device}"
        log_event(log, "joined", text, run=run, worker=self._link.identity)
        self._note_version()

    def _main_loop(self) -> str:
        """Work; return why it ended."""
        now = monotonic()
        while not (why := self._membership.find_end(now, busy=self._slots.busy or len(self._outbox) > 0)):
            before = now
            self._wait()
            now = monotonic()
            # R21: after a suspension the gap is added to the slots' deadlines, so that no child counts as hanging.
            self._slots.check(now, gap=now - before if now - before > CLOCK_GAP else 0.0)
            if self._membership.start_draining_if_due(now):
                # R24: the next heartbeat does not list unstarted jobs, so the coordinator gives them away at once.
                self._backlog.clear()
                self._slots.abandon_waiting()
                most = f"{self._membership.conditions.drain_timeout:g} s, a second signal leaves at once"
                log_event(log, "draining", f"draining for at most {most}: running episodes finish, queued jobs go back")
            if self._membership.is_leaving(now):
                self._slots.yield_idle_slots()
            else:
                self._slots.fill(self._backlog, undelivered=len(self._outbox))
            self._send(now)
            if self._membership.must_rejoin(now, self._load()):
                self._rejoin(now)
            elif self._membership.start_search_if_due(now):
                self._say_waiting()
                self._follow_run()
                self._say_shut_out()
        return why

    def _shutdown(self, why: str) -> None:
        # R24: a last heartbeat without capacity says that this worker left in order and was not killed, and why.
        self._send_heartbeat(monotonic(), capacity=0, reason=why)
        for each in self._declared:
            each.undeclare()
        run, steps = self._admission.run, plural(self._steps_finished, "environment step")
        done = f"{plural(self._finished, 'job')}, {steps}{self._lost_results()}"
        log_event(log, "left", f"leaving run {run} ({why}): {done}", run=run)

    def _lost_results(self) -> str:
        """Which finished results go with this worker, in words."""
        lost = len(self._outbox)
        them = plural(lost, "finished result")
        return f"; {them} that its coordinator has not taken {'is' if lost == 1 else 'are'} lost" if lost else ""

    def _wait(self) -> None:
        """Handle all waiting events; without any, wait for one until something must be sent."""
        timeout = min(max(self._next_heartbeat_at - monotonic(), 0.0), self._admission.intervals.repeat / 4)
        timeout = min(timeout, BURST_INTERVAL) if len(self._uploads) else timeout
        timeout = min(timeout, BATCH_INTERVAL) if self._slots.awaits_jobs else timeout
        with suppress(queue.Empty):
            self._handle(*self._events.get(timeout=timeout))
            while True:
                self._handle(*self._events.get_nowait())

    def _handle(self, kind: str, event: Any) -> None:
        """Handle one event.

        R7: an error in a coordinator's message costs only that message, which is repeated, and never ends the worker.
        An error in a slot's event does end it, for example when no slot can start.
        """
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
            if self._membership.run_is_over:
                return  # it ended the run and left, as it said
            self._say_waiting()
            return
        self._said_waiting = self._said_shut_out = False
        if self._membership.add_coordinator(nonce):  # joining another incarnation is logged by `_rejoin`
            run = self._admission.run
            log_event(log, "coordinator back", f"the coordinator of run {run} is back; this worker continues", run=run)

    def _say_waiting(self) -> None:
        """Log once that no coordinator is in sight. One that was killed as this worker joined was never in sight."""
        if not self._said_waiting:
            self._said_waiting = True  # docs/how-to/monitor.md says what is logged
            run, plan = self._admission.run, self._membership.plan_without_coordinator
            text = f"the coordinator of run {run} left or cannot be reached; this worker {plan}"
            log_event(log, "coordinator gone", text, run=run)

    def _say_shut_out(self) -> None:
        """Log once that a secured router shows this worker no coordinator: to a revoked one it shows nothing."""
        if self._link.secured and not self._said_shut_out and list(self._link.session.info.routers_zid()):
            self._said_shut_out = True
            text = (
                f"a router answers, and shows this worker no coordinator of run {self._admission.run}: it is not "
                f"served, a router between is away, or {self._link.identity} was revoked and needs another join file"
            )
            log_event(log, "shut out", text, level=logging.WARNING, run=self._admission.run)

    def _handle_batch(self, payload: bytes) -> None:
        """Handle jobs, cancellations and verdicts.

        R12: a batch of another incarnation or of an older numbering is ignored: the coordinator has said its content
        again since. A batch of a newer numbering only makes this worker say hello.
        R9: a cancelled job stops at its next step, so that no slot works for nothing.
        """
        batch = self._link.inbox.decode(JobBatch, payload)
        if batch is None:
            return
        ours = self._admission
        if (batch.run_uid, batch.incarnation, batch.nonce) != (ours.run_uid, ours.incarnation, ours.nonce):
            self._link.inbox.dropped["foreign coordinator"] += 1
            return
        if batch.numbering < self._backlog.numbering:
            self._link.inbox.dropped["earlier numbering"] += 1
            return
        if batch.numbering > self._backlog.numbering:
            self._link.inbox.dropped["unheard numbering"] += 1
            self._membership.suspect_forgotten()
            return
        self._membership.note_activity(monotonic())
        if batch.leave or batch.ended:
            ending = f"ended{f' after {one_line(batch.why)}' if batch.why else ''}" if batch.ended else ""
            self._membership.end_run(f"the run has {ending}" if ending else "the run dismissed its workers", ending)
        for digest in batch.cancels:
            self._slots.abandon(digest)
        for job, why in self._backlog.add_batch(batch, self._slots.wanted_digests):
            if len(self._outbox) < MAX_LEASES:  # R26: a heartbeat can list no more, and the job is given again
                self._outbox.add(Result(job.digest, None, 0, 0.0, why, None))
        judged = [verdict.digest for verdict in batch.verdicts]
        self._outbox.acknowledge(judged)
        self._uploads.acknowledge(judged)
        if self._membership.draining:  # R24: jobs that were on their way go back; the next heartbeat does not list them
            self._backlog.clear()

    def _handle_slot_event(self, event: SlotEvent) -> None:
        if isinstance(event.message, SampledFrame):  # the coordinator owes it no answer: its silence is not restarted
            work = self._slots.find_job(event.slot, event.child_number, event.message)
            if work is not None:
                self._frame_publisher.show(self._admission, event.slot, work, event.message)
            return
        self._membership.note_activity(monotonic())
        ready = self._slots.ready_count
        results = self._slots.handle(event)
        if self._slots.ready_count > ready:
            self._next_heartbeat_at = 0.0  # report new capacity at once
        for result in results:
            self._finished += 1
            self._steps_finished += result.steps
            self._outbox.add(result)
        if results and event.upload is not None:
            self._uploads.add(results[0].digest, event.upload)

    def _send(self, now: float) -> None:
        """Send what is due.

        R19: the heartbeat comes first, because only a heartbeat makes this worker a member whose results count.
        """
        if now >= self._next_heartbeat_at:
            self._next_heartbeat_at = now + self._admission.intervals.beat
            self._send_heartbeat(now, capacity=0 if self._membership.draining else self._slots.capacity)
        for results in self._outbox.due(now):
            self._sender.send_results(self._slots, results)
        for part in self._uploads.due(now):
            self._sender.send_part(part)

    def _send_heartbeat(self, now: float, capacity: int, reason: str = "") -> None:
        rate = self._rate.update(now, self._steps_finished + self._slots.steps)
        self._sender.send_heartbeat(self._slots, self._backlog, self._outbox, capacity, rate, reason)

    def _load(self) -> WorkerLoad:
        idle = self._slots.idle and not len(self._backlog)  # with jobs queued, other runs have the slots
        return WorkerLoad(idle=idle, awaits_verdict=len(self._outbox) > 0, uploading=len(self._uploads) > 0)

    def _rejoin(self, now: float) -> None:
        """Say hello again.

        R22: an extra hello is harmless. Running jobs go on and results without a verdict are kept; if the answer starts
        a new numbering, queued jobs are dropped and given again.
        """
        self._membership.note_hello_sent(now, RETRY * random.uniform(0.5, 1.5))  # noqa: S311 - no secret
        admission = self._link.request_admission(self._admission.run, self._slots.host_class, self._admission.run_uid)
        if admission is None:
            return
        if (admission.run_uid, admission.spec) != (self._admission.run_uid, self._admission.spec):
            raise RefusedError(f"run {admission.run} is another run now")
        restarted = self._adopt(admission)
        self._membership.rejoin(admission.nonce, monotonic())
        level = logging.INFO if restarted else logging.DEBUG  # an idle worker of a paused run says hello repeatedly
        text = f"joined run {admission.run} again, incarnation {admission.incarnation}"
        log_event(log, "rejoined", text, level=level, run=admission.run)
        self._note_version()

    def _note_version(self) -> None:
        """Log once for each version of the coordinator that it is not this worker's."""
        run, version, own = self._admission.run, self._admission.package, package_version("dreamfleet")
        if version not in (own, self._coordinator_version):
            these = f"run {run} is of dreamfleet {version}, and this worker of {own}"  # docs/how-to/upgrade.md
            text = f"{these}: install {version} here and start the worker again"
            log_event(log, "other version", text, level=logging.WARNING, run=run, package=version)
        self._coordinator_version = version

    def _follow_run(self) -> None:
        """Join the run under another name, if it is live under one: its folder was moved, renamed or rescued.

        R22: its uid is the same, so running jobs go on and results without a verdict are kept. Another answer than
        a welcome of this run decides nothing, because anybody could have sent it.
        """
        joined = self._admission
        names = find_names_of_run(self._link.session, joined.run_uid)
        if not names or joined.run in names:  # its token says when that one is back
            return
        try:
            admission = self._link.request_admission(names[0], self._slots.host_class, joined.run_uid)
        except RefusedError as error:
            self._error_counter.record("run of another name", error, names)
            return
        if admission is None or (admission.run_uid, admission.spec) != (joined.run_uid, joined.spec):
            return
        log.info("run %s continues under the name %s", joined.run, admission.run)
        for each in self._declared:
            each.undeclare()
        self._slots.show(False)
        self._adopt(admission)
        self._startup()

    def _adopt(self, admission: Admission) -> bool:
        """Go on under another admission to the same run; return whether its coordinator is in another incarnation.

        R12: under a new numbering of batches the coordinator gives the queued jobs again, so they are dropped here.
        R7: every result without a verdict is sent again at once, because the coordinator may not have the last sending.
        """
        restarted = admission.nonce != self._admission.nonce
        self._admission = admission
        self._sender = CoordinatorSender(self._link.session, self._link.identity, admission)
        if restarted or admission.numbering != self._backlog.numbering:
            self._backlog.start_numbering(admission.numbering)
            self._backlog.clear()
            self._outbox.resend_all()
            self._uploads.resend_all()
            self._next_heartbeat_at = 0.0
        return restarted
