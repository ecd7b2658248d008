"""Who works on what: credits, leases, losses, verdicts. Pure: events and a clock in, batches out.

No message is trusted to arrive. A batch is kept until its worker has seen it; a job is wanted until its first valid
result; what a beat does not show is dispatched again. Rules 2, 3, 5, 6, 7 and 8 of the protocol.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from dreamfleet.common.monitoring.status import EventKind
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.messages import MAX_SLOTS, Heartbeat, Kind, Result, Verdict, VerdictWord
from dreamfleet.coordinator.dispatch.event_log import EventLog
from dreamfleet.coordinator.dispatch.host_stats import HostStats
from dreamfleet.coordinator.dispatch.member import DispatchGroup, Lease, Member, SentBatch
from dreamfleet.coordinator.dispatch.packing import BatchContent, pack
from dreamfleet.coordinator.dispatch.pending_jobs import PendingJob, PendingJobs
from dreamfleet.coordinator.dispatch.speculative_execution import Move, SpeculativeExecution
from dreamfleet.coordinator.dispatch.worker_selection import WorkerSelection
from dreamfleet.coordinator.jobs.work import Work

DEPARTURE_GRACE = 0.05  # seconds: a token's end overtakes results that are still on their way
CLOCK_GAP = 2.0  # seconds between ticks that mean a suspended host
SILENT_BEATS = 5
ABSENT_BEATS = 2
ALIVE_BEATS = 2  # within which a worker has spoken that lives
ANSWER_BEATS = 2  # after which a worker that was sent nothing hears that it is known
FORGET_AFTER = 600.0  # seconds of silence after which a worker must say hello again
GUEST_TIMEOUT = 60.0  # the same for one that was welcomed and has not beaten yet: a guest
MOST_GUESTS = 256
LOST_TIMEOUT = 600.0  # seconds for which who vanished without a word is told as lost, unless he is back
MOST_LOST = 256  # of whom so many are told, those that vanished last
MOST_RECORDS = 4096  # of hosts, those that joined last


@dataclass(frozen=True)
class OutgoingBatch:
    """A numbered batch for one worker; 0 is an empty one that only says that the worker is known."""

    identity: str
    numbering: int
    number: int
    content: BatchContent


class Fleet:
    """The workers of one run and the jobs between them."""

    def __init__(self, beat: float, evaluation_share: float = 0.25) -> None:
        self._beat = beat
        self._tail = SpeculativeExecution(beat)
        self._numberings = 0  # that were begun
        self._last_tick: float | None = None
        self._now = 0.0  # of what is being handled
        self._host_stats: dict[str, HostStats] = {}  # by name of a host, the one that joined last at the end
        self._guests: dict[str, None] = {}  # identities, oldest first
        self.lost: dict[str, Member] = {}  # who vanished without a word, the last one at the end; told, no more
        self.jobs = PendingJobs(evaluation_share)
        self.members: dict[str, Member] = {}
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()  # what was not believed, by reason
        self.event_log = EventLog()  # of workers and jobs, for whoever asks
        self.notes: list[str] = []  # what happened, for whoever writes it down and clears it
        self.drain_background = False  # nothing but evaluations and collected rollouts is left to wait for
        self.paused = False
        self.single_job = False  # what is scored now, a slot does by itself, however wide the run's task is

    def cancel_kind(self, kind: Kind) -> None:
        """No longer want jobs of this kind; what runs already becomes obsolete."""
        for digest in self.jobs.digests_of_kind(kind):
            self._cancel(digest, self.jobs.remove(digest))

    def add_worker(self, identity: str, slots: int, fingerprint: str, now: float) -> int:
        """A worker was admitted; it has credit from its first beat on, and until then it is one of a few guests.

        Its batches are counted anew, under the number that is returned. But a hello in the name of one that beats
        changes nothing: the worker is told what it missed, and a stranger who greets as somebody else takes nothing.
        """
        old = self.members.get(identity)
        if old is not None and old.has_beaten and old.present and now - old.last_heard <= ALIVE_BEATS * self._beat:
            old.mark_for_resend(now - self._beat)
            return old.numbering
        if old is not None:
            self._remove_member(old)
        if len(self._guests) >= MOST_GUESTS:
            self._remove_member(self.members[next(iter(self._guests))])
        self._guests[identity] = None
        slots, joined_at = min(slots, MAX_SLOTS), now if old is None else old.joined_at
        host_stats = self._find_host_stats(identity, old)
        member = Member(identity, slots, fingerprint, self._next_numbering(), now, joined_at, host_stats)
        self.members[identity] = member
        return member.numbering

    def handle_departure(self, identity: str, now: float) -> None:
        """A worker's token vanished."""
        if (member := self.members.get(identity)) and member.lost is None:
            member.lost = now

    def remove_worker(self, identity: str) -> None:
        """Forget a worker; others get its jobs, and what it says counts no more until it is welcomed again."""
        if member := self.members.get(identity):
            self._remove_member(member)

    def handle_heartbeat(self, identity: str, beat: Heartbeat, now: float) -> None:
        """Reconcile what the worker holds with what it was given."""
        member, self._now = self.members.get(identity), now
        if member is None:
            return
        self._mark_heard(member, now)
        if identity in self._guests:  # until it has beaten it may be anybody, and strangers would fill the story
            del self._guests[identity]
            self.event_log.add(now, "back" if identity in self.lost else "joined", identity)
            self._drop_from_lost(identity)
        if beat.numbering != member.numbering:
            # It was late, or its worker has not heard of the welcome: what it had queued, it will then forget.
            beat = replace(beat, seen=0, queued=())
        elif beat.seen > member.number:  # somebody else sent batches in this coordinator's name: they are counted anew
            self._restart_numbering(member)
            self.dropped["count of batches"] += 1
            beat = replace(beat, seen=0, queued=())
        if self.single_job:
            beat = replace(beat, capacity=min(beat.capacity, beat.slots))
        for sent in member.apply_beat(beat, now):
            for work in sent.content.work:
                self.event_log.add(now, "seen", identity, work.job.digest)
        running = {self.jobs.digest_of_tag(run.tag): run.steps for run in beat.running}
        shown = {self.jobs.digest_of_tag(tag) for tag in (*beat.queued, *beat.unacked)} | running.keys()
        for digest, lease in list(member.leases.items()):
            lease.absent_beats = 0 if digest in shown or lease.batch > beat.seen else lease.absent_beats + 1
            lease.steps, lease.steps_seen_at = running.get(digest), now
            if lease.absent_beats >= ABSENT_BEATS:
                self._drop_lease(member, digest)
        held = DispatchGroup(now, len(member.leases), only_scoring=False)
        for found in shown - member.leases.keys():
            if found is not None and self._may_readopt(found, identity):
                self._add_lease(member, found, Lease(beat.seen, held, steps=running.get(found), steps_seen_at=now))
        member.mark_lost_before(max((lease.batch for each, lease in member.leases.items() if each in shown), default=0))

    def handle_result(self, identity: str, result: Result, now: float) -> tuple[VerdictWord, Work | None]:
        """Judge one result; the work comes back when it is the first wanted one, for the journal."""
        member, self._now = self.members.get(identity), now
        given = self.find_job_for_result(identity, result)
        if given is None and (member is None or not member.has_beaten):
            self.dropped["result of a stranger"] += 1  # who says it again once the run knows him
            return "refused", None
        if member is not None:
            self._mark_heard(member, now)
            member.record_return(result)
        lease = None if member is None else member.leases.get(result.digest)
        verdict, work = self._judge(identity, result, given)
        if lease is not None and work is not None:
            self._tail.record_duration(now - lease.group.given_at, is_background=lease.is_background)
        if member is not None or verdict == "accepted":
            self.event_log.add(now, verdict, identity, result.digest)
        if member is not None:
            member.leases.pop(result.digest, None)
            member.verdicts.append(Verdict(result.digest, verdict))
            member.finished += verdict == "accepted"
            if work is not None:
                member.host_stats.record_duration(work.job.kind, result.seconds)
        if verdict == "accepted":
            self._tail.record_episode(result.steps)
        self.counts["accepted_steps" if verdict == "accepted" else "discarded_steps"] += result.steps
        self.counts[verdict] += 1
        return verdict, work

    def find_job_for_result(self, identity: str, result: Result) -> Work | None:
        """The wanted job of which this worker may bring this result; `None` where there is none.

        It brings what it was given in this life of the coordinator, whether or not it still holds the lease. What an
        earlier life may have given counts from any worker that has been welcomed and has beaten, for nobody knows
        whom it was given to. A failure counts only from who holds the lease.
        """
        pending, member = self.jobs.get(result.digest), self.members.get(identity)
        if pending is None or not self.jobs.may_have_been_given(result.digest, identity):
            return None
        known = identity in pending.given_to or (member is not None and member.has_beaten)
        return pending.work if known and (result.fitness is not None or identity in pending.holders) else None

    def overrun(self, identity: str, digest: bytes) -> None:
        """A worker tells more steps of a job than it can have: it had better be scored elsewhere."""
        if (member := self.members.get(identity)) and digest in member.leases:
            self.dropped["lease with more steps than a job has"] += 1
            self.jobs.overrun(digest, identity)
            member.cancels.append(digest)
            self._drop_lease(member, digest)

    def defer_verdict(self, identity: str, digest: bytes, now: float) -> None:
        """A result came whose upload is still on its way: no verdict yet, and the lease stays."""
        member = self.members.get(identity)
        if member is None:
            return
        self._mark_heard(member, now)
        lease = member.leases.get(digest)
        if lease is not None and lease.upload_pending_since is None:
            lease.upload_pending_since = now

    def tick(self, now: float) -> None:
        """Let time pass: departures, silences, batches to send again."""
        gap = now - self._last_tick if self._last_tick is not None else 0.0
        self._last_tick = self._now = now
        self.lost = {name: each for name, each in self.lost.items() if now - each.last_heard <= LOST_TIMEOUT}
        for member in list(self.members.values()):
            if gap > CLOCK_GAP:
                self._excuse_suspension(member, gap)
            if member.lost is not None:
                if now - max(member.lost, member.last_heard) >= DEPARTURE_GRACE:
                    self._release_lost(member, now, "is gone without a word" if member.capacity else "left")
                    self._remove_member(member)
                    self._remember_lost(member)
            elif now - member.last_heard > (FORGET_AFTER if member.has_beaten else GUEST_TIMEOUT):
                self._remove_member(member)
            elif not member.silent and now - member.last_heard > SILENT_BEATS * self._beat:
                member.silent = True
                self._release_lost(member, now, "is silent")
                self._restart_numbering(member)  # what it has not seen is not sent again
                self.counts["silences"] += 1

    def dispatch(self, now: float, *, durable: bool = True) -> list[OutgoingBatch]:
        """Batches to send now: verdicts, cancellations, jobs to credit, and what was not seen in time.

        Verdicts stay until everything so far is `durable`.
        """
        self._now = now
        for member in self.members.values():
            member.learn(now)
        given = self._assign(now)
        if not self.jobs.queued and not self.paused:
            for move in self._tail.plan(self.jobs, self.members, given, now):
                self._apply_move(move, given, now)
        if not self.paused:
            for move in self._tail.plan_trials(self.jobs, self.members, given.keys(), now):
                self._apply_move(move, given, now)
        sends: list[OutgoingBatch] = []
        for member in self.members.values():
            if not (member.present and member.has_beaten):
                continue
            said = [
                *self._overdue_batches(member, now),
                *self._new_batches(member, given.get(member.identity, ()), durable, now),
            ]
            if not said and member.is_owed_reply(now, ANSWER_BEATS * self._beat):
                said = [OutgoingBatch(member.identity, member.numbering, 0, BatchContent())]
            member.last_sent = now if said else member.last_sent
            sends += said
        return sends

    @property
    def lease_count(self) -> int:
        """Jobs in workers' hands, copies counted."""
        return sum(len(member.leases) for member in self.members.values())

    def _overdue_batches(self, member: Member, now: float) -> Iterator[OutgoingBatch]:
        """Batches that were not seen in time."""
        for number in member.overdue(now, 2 * self._beat):
            sent = member.unseen[number]
            sent.sent_at, sent.times = now, sent.times + 1
            self.counts["resent_batches"] += 1
            member.resent += 1
            for work in sent.content.work:
                self.event_log.add(now, "sent again", member.identity, work.job.digest)
            yield OutgoingBatch(member.identity, member.numbering, number, sent.content)

    def _new_batches(self, member: Member, given: Sequence[Work], durable: bool, now: float) -> Iterator[OutgoingBatch]:
        """Batches that it was not sent yet."""
        group = member.new_group(now)
        for content in pack(given, member.cancels, member.verdicts if durable else []):
            member.number += 1
            member.unseen[member.number] = SentBatch(content, now, now)
            for work in content.work:
                self._add_lease(member, work.job.digest, Lease(member.number, group))
                self.event_log.add_given(now, member.identity, work.job)
            yield OutgoingBatch(member.identity, member.numbering, member.number, content)
        member.cancels = []
        if durable:
            member.verdicts = []

    def _judge(self, identity: str, result: Result, given: Work | None) -> tuple[VerdictWord, Work | None]:
        if result.digest not in self.jobs:
            return ("duplicate" if self.jobs.is_accepted(result.digest) else "obsolete"), None
        if given is None:
            self.dropped["result of a job that was not given"] += 1
            return "refused", None
        if result.fitness is None:
            self.jobs.record_failure(identity, result)
            self.counts["errors"] += 1
            if member := self.members.get(identity):
                self._drop_lease(member, result.digest)
            return "refused", None
        pending = self.jobs.accept(result)
        pending.holders.discard(identity)
        self._cancel(result.digest, pending)
        return "accepted", pending.work

    def _cancel(self, digest: bytes, pending: PendingJob) -> None:
        """Whoever holds a job that is wanted no more hears so."""
        for holder in pending.holders:
            member = self.members[holder]
            lease = member.leases.pop(digest, None)
            if lease is not None:
                member.record_superseded(lease, self._now)
            if digest not in member.trial_copies:  # which is worth its end
                member.cancels.append(digest)
            self.counts["discarded_steps"] += (lease and lease.steps) or 0

    def _may_readopt(self, digest: bytes, identity: str) -> bool:
        """Whether a worker that shows a wanted job has its lease again."""
        pending = self.jobs[digest]
        free = len(pending.holders) < 2 and identity not in pending.overrun
        return free and self.jobs.may_have_been_given(digest, identity)

    def _restart_numbering(self, member: Member) -> None:
        """Whatever a worker has is given again, in another numbering, unless it shows it."""
        self._release_leases(member)
        member.begin_numbering(self._next_numbering())

    def _next_numbering(self) -> int:
        self._numberings += 1
        return self._numberings

    def _mark_heard(self, member: Member, now: float) -> None:
        member.last_heard = now
        if member.silent and member.has_beaten:  # else its silence was not told either
            self.event_log.add(now, "back", member.identity)
        member.silent = False

    def _excuse_suspension(self, member: Member, gap: float) -> None:
        """A suspended host's gap is nobody's silence."""
        member.last_heard += gap
        for sent in member.unseen.values():
            sent.sent_at += gap
        member.shift_clock(gap)

    def _find_host_stats(self, identity: str, old: Member | None) -> HostStats:
        """What is known of this worker's host, which every life of it goes on from."""
        name = identity.partition("/")[0]
        last = self._host_stats.pop(name, None)
        host_stats = old.host_stats if old else last.copy() if last else HostStats()
        self._host_stats[name] = host_stats
        while len(self._host_stats) > MOST_RECORDS:
            del self._host_stats[next(iter(self._host_stats))]
        return host_stats

    def _release_lost(self, member: Member, now: float, what: str) -> None:
        if not member.has_beaten:
            return  # nothing was given to it, and no log should grow with what strangers call themselves
        freed = f"{plural(len(member.leases), 'job')} {'is' if len(member.leases) == 1 else 'are'} free again"
        self.notes.append(f"worker {member.identity} {what}: {freed}")
        gone: EventKind = "lost" if member.capacity else "left"
        self.event_log.add(now, "silent" if member.lost is None else gone, member.identity)
        if member.leases:
            last = self._host_stats.get(member.identity.partition("/")[0], member.host_stats)
            last.record_death(now - member.joined_at)
        self._release_leases(member)

    def _add_lease(self, member: Member, digest: bytes, lease: Lease) -> None:
        lease.is_background = self.jobs[digest].is_background
        member.leases[digest] = lease
        self.jobs.add_holder(digest, member.identity)

    def _apply_move(self, move: Move, given: dict[str, list[Work]], now: float) -> None:
        """Give a job to an idle slot too, or instead of to a worker that has not begun it."""
        if move.instead_of:
            donor = self.members[move.instead_of]
            donor.leases.pop(move.digest)
            donor.cancels.append(move.digest)
            self.jobs.remove_holder(move.digest, donor.identity)
            self.event_log.add(now, "recalled", donor.identity, move.digest)
        else:
            self.event_log.add(now, "copied", move.to, move.digest)
        if move.trial:
            self.members[move.to].trial_copies[move.digest] = DispatchGroup(now, 0)
        self.counts["recalled" if move.instead_of else "copied"] += 1
        self.jobs.add_holder(move.digest, move.to)
        given.setdefault(move.to, []).append(self.jobs[move.digest].work)

    def _drop_lease(self, member: Member, digest: bytes) -> None:
        """End a lease without a result; the job is queued again unless another worker holds it."""
        member.leases.pop(digest, None)
        if self.jobs.remove_holder(digest, member.identity):
            self.counts["reissued"] += 1
            self.event_log.add(self._now, "reissued", member.identity, digest)
            self.jobs.enqueue(digest)

    def _remove_member(self, member: Member) -> None:
        """It is nobody's member any more; one that lives says hello again, for it is silent to it in turn."""
        self._release_leases(member)
        self._guests.pop(member.identity, None)
        del self.members[member.identity]

    def _remember_lost(self, member: Member) -> None:
        """Its token vanished. One that left had said that it takes no more; of any other it is told that it is lost."""
        if member.has_beaten and member.capacity:
            self.lost[member.identity] = member
            if len(self.lost) > MOST_LOST:
                del self.lost[next(iter(self.lost))]

    def _drop_from_lost(self, identity: str) -> None:
        """It is back, or another life of a lost worker of its host is there in its place."""
        host = identity.partition("/")[0]
        others = (name for name in self.lost if name.partition("/")[0] == host)
        self.lost.pop(identity if identity in self.lost else next(others, ""), None)

    def _release_leases(self, member: Member) -> None:
        for digest in list(member.leases):
            self._drop_lease(member, digest)
        member.unseen.clear()
        member.trial_copies.clear()

    def _assign(self, now: float) -> dict[str, list[Work]]:
        """One job at a time to the least loaded worker with credit that helps, so that a tail is spread evenly."""
        given: dict[str, list[Work]] = {}
        if self.paused:
            return given
        loads = {name: len(member.leases) for name, member in self.members.items() if member.credit > 0}
        choice = WorkerSelection(self.members, loads, self.jobs.queued, now)
        slots = sum(member.slots for member in self.members.values() if member.present and member.capacity)
        passed_over = []
        while loads:
            idle = any(load < self.members[name].capacity for name, load in loads.items())
            if (next_job := self.jobs.next(slots, idle=idle, drain_background=self.drain_background)) is None:
                break
            pending = self.jobs[next_job.digest]
            eligible = self._eligible_workers(pending, loads)
            if not eligible:
                passed_over.append(next_job.digest)
                continue
            name = choice.pick(eligible)
            if name is None and not pending.avoided_workers:
                passed_over.append(next_job.digest)
                break  # nor the jobs after it: they had better wait for whoever is sooner
            name = name or min(eligible, key=lambda name: loads[name])
            choice.assign(name)
            given.setdefault(name, []).append(pending.work)
            self.jobs.add_holder(next_job.digest, name, by_share=next_job.by_share)
            loads[name] += 1
            if len(given[name]) >= self.members[name].credit:
                del loads[name]
        for digest in passed_over:
            self.jobs.enqueue(digest)
        return given

    def _eligible_workers(self, pending: PendingJob, loads: Mapping[str, int]) -> list[str]:
        """Who of these may be given this job: not where it failed, unless nobody else is there or about to be.

        A killed child must not hang a run, nor may a stranger who only said hello.
        """
        eligible = [name for name in loads if name not in pending.avoided_workers]
        there = (name for name, member in self.members.items() if member.present and member.has_beaten)
        return list(loads) if not eligible and all(name in pending.avoided_workers for name in there) else eligible
