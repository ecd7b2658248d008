"""The workers of a run and the jobs between them. Pure: events and a clock in, batches out.

No message is trusted to arrive. A batch is kept until its worker confirms it, a job is wanted until its first valid
result, and a job that heartbeats do not list is given again. Pages: fleet.md, threats.md.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import count
from typing import Literal

from msgspec.structs import replace

from dreamfleet.common.client.status import EventKind
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.protocol.messages import MAX_SLOTS, Heartbeat, Result, Verdict, VerdictWord
from dreamfleet.coordinator.dispatch.event_log import EventLog, Note, NoteKind
from dreamfleet.coordinator.dispatch.failure_judge import FailureJudge
from dreamfleet.coordinator.dispatch.host_stats import HostRecords
from dreamfleet.coordinator.dispatch.leases import Leases
from dreamfleet.coordinator.dispatch.member import DepartedWorkers, DispatchGroup, Member, MemberState
from dreamfleet.coordinator.dispatch.packing import SentBatch, pack
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJobs
from dreamfleet.coordinator.dispatch.speculative_execution import SpeculativeExecution
from dreamfleet.coordinator.dispatch.worker_selection import assign_jobs
from dreamfleet.coordinator.jobs.checks import Check
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob

DEPARTURE_GRACE = 0.05  # seconds: a vanished token overtakes results that are still on their way
CLOCK_GAP = 2.0  # seconds between ticks that mean that this host was suspended; as worker/service/run_session.py
# In heartbeat intervals:
SILENT_AFTER = 5  # without a message a worker counts as silent
ALIVE_WITHIN = 2  # of its last message a worker is surely alive
REPLY_AFTER = 2  # a worker to which nothing was sent gets an empty batch
RESEND_AFTER = 2  # an unconfirmed batch is sent again
# In seconds without a message:
FORGET_AFTER = 600.0  # a worker is forgotten and must say hello again
UNCONFIRMED_TIMEOUT = 60.0  # the same for one that has sent no heartbeat
MAX_UNCONFIRMED = 256


class Fleet:
    """The workers of one run and the jobs between them."""

    def __init__(self, heartbeat_interval: float, evaluation_share: float = 0.25) -> None:
        self._interval = heartbeat_interval  # seconds
        self._numberings = count(1)
        self._last_tick: float | None = None
        self._planned_at: float | None = None  # when jobs were given that no commit has followed yet
        self._hosts = HostRecords()
        self.departed = DepartedWorkers()
        self.jobs = PendingJobs(evaluation_share)
        self.members: dict[str, Member] = {}
        self.speculation = SpeculativeExecution(heartbeat_interval, self.jobs, self.members)
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()  # results and reports that were not accepted, by reason
        self.event_log = EventLog()
        self.leases = Leases(self.jobs, self.members, self.event_log, self.counts)
        self.notes: list[Note] = []  # their writer clears them
        self.failure_judge = FailureJudge(self.jobs, self.members)
        self.drain_background = False  # only evaluations and kept rollouts are left to wait for
        self.paused = False
        self.checked: ScoringJob | None = None  # the job whose accepted result the last result repeats

    def add_worker(self, identity: str, slots: int, fingerprint: str, now: float) -> int:
        """Welcome a worker, unconfirmed; return the numbering of its batches.

        R12: a welcome starts a new numbering, so messages from before cannot be mistaken for current ones. R19: hello
        in the name of a live worker changes nothing, so an unknown sender cannot take its leases. That worker only gets
        again what it may have missed. R26: the number of unconfirmed workers is bounded.
        """
        old, recent = self.members.get(identity), ALIVE_WITHIN * self._interval
        if old is not None and old.state is MemberState.PRESENT and now - old.last_heard <= recent:
            old.resend_sent_before(now - self._interval)
            return old.numbering
        self.remove_worker(identity)
        unconfirmed = [member for member in self.members.values() if member.is_unconfirmed]
        if len(unconfirmed) >= MAX_UNCONFIRMED:
            self.remove_worker(unconfirmed[0].identity)
        slots, joined_at = min(slots, MAX_SLOTS), now if old is None else old.joined_at
        host_stats = self._hosts.join(identity, None if old is None else old.host_stats)
        numbering = next(self._numberings)
        self.members[identity] = Member(identity, slots, fingerprint, numbering, now, joined_at, host_stats)
        return numbering

    def handle_departure(self, identity: str, now: float) -> None:
        """Note that a worker's token vanished."""
        if (member := self.members.get(identity)) and member.gone_since is None:
            member.gone_since = now

    def note(self, text: str, what: NoteKind) -> None:
        """Note something for the log and the journal."""
        self.notes.append(Note(text, what))

    def note_refusal(self, note: Note, why: str) -> None:
        """Log that a worker, or a host, was refused; the caller bounds how many are (R26)."""
        self.notes.append(note)
        self.event_log.add("left", note.worker, why=f"refused: {why}")

    def remove_worker(self, identity: str) -> None:
        """Forget a worker: others get its jobs. If it is alive it gets no answer, and so says hello again (R22)."""
        if member := self.members.pop(identity, None):
            self.leases.release(member)

    def handle_heartbeat(self, identity: str, beat: Heartbeat, now: float) -> None:
        """Compare what a worker reports with what it was given.

        R3, R20: a lease that the worker does not show ends. R11: a confirmed batch is not sent again. R19: the first
        heartbeat confirms a worker.
        """
        member, self.event_log.now = self.members.get(identity), now
        if member is None:
            return
        self._mark_heard(member, now)
        if member.is_unconfirmed:  # R26: only now is it logged, as unknown senders could fill the log with names
            self._note_arrival(identity, "back" if identity in self.departed else "joined")
            self.departed.remove(identity)
            if beat.reason:  # R24: it fails before it can score, and has no token that could vanish
                self.handle_departure(identity, now)
        beat = self._check_numbering(member, beat)
        for sent in member.apply_heartbeat(beat, now):
            for work in sent.work:
                self.event_log.add("seen", identity, work.digest)
        running = {self.jobs.digest_of_tag(run.tag): run.steps for run in beat.running}
        finished = {self.jobs.digest_of_tag(tag) for tag in beat.unacked}
        listed = {self.jobs.digest_of_tag(tag) for tag in beat.queued} | finished | running.keys()
        for digest in member.update_leases(listed, running, finished, now):
            self.leases.drop(member, digest)
        held = DispatchGroup(now, len(member.leases), only_scoring=False)
        for found in listed - member.leases.keys():
            if found is not None and self.leases.may_readopt(found, identity):
                self.leases.add(member, found, beat.seen, held, running.get(found))
        member.resend_before(max((lease.batch for each, lease in member.leases.items() if each in listed), default=0))

    def handle_result(
        self, identity: str, result: Result, now: float, host_class: str = ""
    ) -> tuple[VerdictWord, ScoringJob | None]:
        """Judge one result; return its work if it is the first valid one of a wanted job, for the journal.

        R5: an unknown worker's result is dropped. R7: a worker of this run gets a verdict on each result, a duplicate
        too, so it can stop repeating it. `checked` is the work of a result that repeats an accepted one (R32).
        """
        member, self.event_log.now, self.checked = self.members.get(identity), now, None
        given = self.find_job_for_result(identity, result)
        if given is None and (member is None or member.is_unconfirmed):
            self.dropped["result of an unknown worker"] += 1  # one of this run repeats it after its first heartbeat
            return "refused", None
        if member is not None:
            self._mark_heard(member, now)
            member.record_return(result)
        lease = None if member is None else member.leases.get(result.digest)
        verdict, work = self._judge(identity, result, given, host_class)
        if lease is not None and work is not None:
            self.speculation.record_duration(now - lease.group.given_at, is_background=lease.is_background)
        if member is not None or verdict == "accepted":
            failed = given is not None and result.fitness is None
            self.event_log.add("failed" if failed else verdict, identity, result.digest)
        if member is not None:
            member.end_lease(result.digest)
            member.add_verdict(Verdict(result.digest, verdict))
            member.finished += verdict == "accepted"
            if work is not None:
                member.host_stats.record_duration(work.kind, result.seconds)
        if verdict == "accepted":
            self.speculation.record_episode(result.steps)
        self.counts["accepted_steps" if verdict == "accepted" else "discarded_steps"] += result.steps
        self.counts[verdict] += 1
        return verdict, work

    def find_job_for_result(self, identity: str, result: Result) -> ScoringJob | None:
        """The wanted job that this worker may answer with this result; `None` if there is none.

        R5: a result counts from a worker that was given the job in this incarnation, with or without the lease. If an
        earlier incarnation may have given the job, it counts from any worker that has sent a heartbeat. An error counts
        only from a holder of the lease. So an unknown sender can neither score nor fail a job.
        """
        pending, member = self.jobs.get(result.digest), self.members.get(identity)
        if pending is None or not self.jobs.may_have_been_given(result.digest, identity):
            return None
        known = identity in pending.given_to or (member is not None and not member.is_unconfirmed)
        return pending.work if known and (result.fitness is not None or identity in pending.holders) else None

    def overrun(self, identity: str, digest: bytes) -> None:
        """End the lease of a worker that reports more steps than the job can have.

        R20: such a worker may never finish, so another one gets the job.
        """
        if (member := self.members.get(identity)) and digest in member.leases:
            self.dropped["lease with more steps than a job has"] += 1
            self.jobs.record_overrun(digest, identity)
            member.cancels.append(digest)
            self.leases.drop(member, digest)

    def defer_verdict(self, identity: str, digest: bytes, now: float) -> None:
        """Keep the lease of a job whose result came and whose upload is still on the way."""
        member = self.members.get(identity)
        if member is None:
            return
        self._mark_heard(member, now)
        lease = member.leases.get(digest)
        if lease is not None and lease.upload_pending_since is None:
            lease.upload_pending_since = now

    def tick(self, now: float) -> None:
        """Let time pass.

        R20: the leases of a worker end shortly after its token vanished, or after five silent intervals. R12: a
        silence starts a new numbering. R21: a gap in this process's own clock is added to all deadlines.
        """
        gap = now - self._last_tick if self._last_tick is not None else 0.0
        self._last_tick = self.event_log.now = now
        self.departed.expire(now)
        self.jobs.enqueue_due(now)
        for member in list(self.members.values()):
            if gap > CLOCK_GAP:
                member.shift_clock(gap)
            if member.gone_since is not None:
                if now - max(member.gone_since, member.last_heard) >= DEPARTURE_GRACE:
                    self._release_lost(member, now, member.departure)
                    self.remove_worker(member.identity)
                    self.departed.add(member)
            elif now - member.last_heard > (UNCONFIRMED_TIMEOUT if member.is_unconfirmed else FORGET_AFTER):
                self.remove_worker(member.identity)
            elif not member.silent and now - member.last_heard > SILENT_AFTER * self._interval:
                member.silent = True
                self._release_lost(member, now, "is silent")
                self._restart_numbering(member)
                self.counts["silences"] += 1

    def dispatch(self, now: float, *, durable: bool = True) -> list[SentBatch]:
        """Batches to send now: verdicts, cancellations, new jobs, and batches to send again.

        R6: verdicts wait until the journal has committed everything so far (`durable`), so a crash loses no result.
        R22: a member without news gets an empty batch, else it would say hello again.
        """
        self.event_log.now = now
        self._share_slots()
        for member in self.members.values():
            member.record_turnarounds(now)
        is_planned = durable and self._planned_at == now  # the turn's jobs went out before its commit
        self._planned_at = None if durable or self.paused else now
        given = {} if self.paused or is_planned else self._plan(now)
        sends: list[SentBatch] = []
        for member in self.members.values():
            if member.state is not MemberState.PRESENT:
                continue
            batches = list(member.take_overdue_batches(now, RESEND_AFTER * self._interval))
            self.counts["resent_batches"] += len(batches)
            for work in (work for batch in batches for work in batch.work):
                self.event_log.add("sent again", member.identity, work.digest)
            batches += self._new_batches(member, given.get(member.identity, ()), durable, now)
            if not batches and member.is_owed_reply(now, REPLY_AFTER * self._interval):
                batches = [SentBatch(member.identity, member.numbering)]
            member.last_sent = now if batches else member.last_sent
            sends += batches
        return sends

    def _share_slots(self) -> None:
        """Let a slot do only so many drives side by side that two rounds are left for each, so that none idles."""
        able = [member for member in self.members.values() if member.side_by_side > 1]
        slots = sum(member.slots for member in self.members.values() if member.takes_jobs) if able else 0
        for member in able:
            member.drives_per_slot = max(1, (len(self.jobs) + self.jobs.unmade) // max(2 * slots, 1))

    @property
    def has_workers(self) -> bool:
        """Whether any worker is present, also one that replaces its scoring processes and takes no job."""
        return any(member.state is MemberState.PRESENT for member in self.members.values())

    @property
    def lease_count(self) -> int:
        """Leases of all workers, copies included."""
        return sum(len(member.leases) for member in self.members.values())

    def _check_numbering(self, member: Member, beat: Heartbeat) -> Heartbeat:
        """The heartbeat, without what it says of batches and queued jobs if that cannot be right.

        R12: a heartbeat of another numbering confirms no batch; what the worker has queued it will forget. One that
        confirms a batch that was not sent shows that somebody else sends in this coordinator's name.
        """
        if beat.numbering == member.numbering:
            if beat.seen <= member.number:
                return beat
            self._restart_numbering(member)
            self.dropped["count of batches"] += 1
        return replace(beat, seen=0, queued=())

    def _plan(self, now: float) -> dict[str, list[ScoringJob]]:
        """The work that each member is given now."""
        judge = self.failure_judge
        given = assign_jobs(
            self.jobs, self.members, judge.working_hosts, judge.hosts_for_suspects, now,
            drain_background=self.drain_background,
        )  # fmt: skip
        if not self.jobs.queue_length:
            for move in self.speculation.plan(given, now):
                self.leases.move(move, given)
        for move in self.speculation.plan_trials(given.keys(), now):
            self.leases.move(move, given)
        return given

    def _new_batches(
        self, member: Member, given: Sequence[ScoringJob], durable: bool, now: float
    ) -> Iterator[SentBatch]:
        """New batches.

        R10: they are numbered without a gap, so the worker can report how many it has.
        """
        group = member.start_group(now)
        verdicts = member.verdicts if durable else []
        for batch in pack(member.identity, member.numbering, given, member.cancels, verdicts):
            member.number = batch.number = member.number + 1
            batch.first_sent_at = batch.sent_at = now
            member.unconfirmed[batch.number] = batch
            for work in batch.work:
                self.leases.add(member, work.digest, batch.number, group)
                self.event_log.add_given(member.identity, work.job)
            yield batch
        member.cancels = []
        if durable:
            member.verdicts = []

    def _judge(
        self, identity: str, result: Result, given: ScoringJob | None, host_class: str
    ) -> tuple[VerdictWord, ScoringJob | None]:
        """The verdict on a result, and its work if it is accepted.

        R4: only the first valid result of a wanted job is accepted. R8: an error is recorded, never a fitness.
        """
        if result.digest not in self.jobs:
            return ("duplicate" if self.jobs.is_accepted(result.digest) else "obsolete"), None
        if given is None and result.digest in self.jobs.checks:
            return "duplicate", None  # a repetition of the accepted one
        if given is None:
            self.dropped["result of a job that was not given"] += 1
            return "refused", None
        if result.fitness is None:
            self.jobs.record_failure(identity, result, self.event_log.now)
            self._note_failure(result.digest)
            if member := self.members.get(identity):
                self.leases.drop(member, result.digest, counted=True)
            return "refused", None
        if result.digest in self.jobs.checks:
            self.checked = given
            self.jobs.remove_holder(result.digest, identity)
            return "duplicate", None
        pending = self.jobs.accept(result)
        self.counts["discarded_steps"] += pending.steps_lost_to(identity, result.steps)
        pending.holders -= {identity}
        if self.jobs.is_drawn(pending.work) and not pending.is_control:
            self.leases.check_again(pending, Check(host_class, {self.jobs.voter_of(identity)}))
        else:
            self.leases.cancel(pending)
        self.failure_judge.working_hosts.add(host_of(identity))
        return ("duplicate", None) if pending.is_control else ("accepted", pending.work)

    def _note_failure(self, digest: bytes) -> None:
        """Count a failed attempt; the first one of each cause is logged."""
        self.counts["errors"] += 1
        failure = self.jobs[digest]
        if self.failure_judge.is_new_cause(failure):
            self.note(f"{failure.describe_failure()}; it is tried again", "retried")

    def _restart_numbering(self, member: Member) -> None:
        """Start a new numbering: its jobs are given again, unless a heartbeat lists them."""
        self.leases.release(member)
        member.start_numbering(next(self._numberings))

    def _mark_heard(self, member: Member, now: float) -> None:
        member.last_heard = now
        if member.silent and not member.is_unconfirmed:  # an unconfirmed one's silence was not logged either
            self._note_arrival(member.identity, "back")
        member.silent = False
        member.held_at_silence.clear()

    def _note_arrival(self, identity: str, what: Literal["joined", "back"]) -> None:
        self.event_log.add(what, identity)
        self.jobs.forgive_losses(identity)
        self.notes.append(Note(f"worker {identity} {'joined' if what == 'joined' else 'is back'}", what, identity))

    def _release_lost(self, member: Member, now: float, what: str) -> None:
        """Release and log a worker that is gone or silent; its host's record counts a loss of jobs."""
        if member.is_unconfirmed:
            return  # it has no jobs, and an unknown sender can invent names without end
        freed = f"; {plural(len(member.leases), 'job')} requeued" if member.leases else ""
        gone: EventKind = "silent" if member.gone_since is None else "lost" if member.is_lost else "left"
        self.notes.append(Note(f"worker {member.identity} {what}{freed}", gone, member.identity))
        self.event_log.add(gone, member.identity, why=member.farewell)
        if member.is_lost:
            # One of the jobs in its hands may have ended it.
            held = {digest for digest, lease in member.leases.items() if not lease.finished} | member.held_at_silence
            for digest in held & self.jobs.keys():
                if self.jobs.record_loss(member.identity, digest, self.event_log.now):
                    self._note_failure(digest)
        elif member.silent:  # it may have ended: its token says so later
            member.held_at_silence = set(member.leases)
        if member.leases:
            (self._hosts.get(member.identity) or member.host_stats).record_loss(now - member.joined_at)
        self.leases.release(member)
