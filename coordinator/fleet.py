"""Who works on what: credits, leases, losses, verdicts. Pure: events and a clock in, batches out.

No message is trusted to arrive. A batch is kept until its worker has seen it; a job is wanted until its first valid
result; what a beat does not show is dispatched again. Rules 2, 3, 5, 6, 7 and 8 of the protocol.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from dreamfleet.common.messages import MOST_SLOTS, TAG_BYTES, Beat, Kind, Result, Verdict, VerdictWord
from dreamfleet.coordinator.choice import Choice
from dreamfleet.coordinator.failure import Failure
from dreamfleet.coordinator.jobs import Work
from dreamfleet.coordinator.member import Handful, Lease, Member, Sent
from dreamfleet.coordinator.packing import Content, pack
from dreamfleet.coordinator.record import HostRecord
from dreamfleet.coordinator.share import Share
from dreamfleet.coordinator.tail import Move, Tail

DEPARTURE_GRACE = 0.05  # seconds: a token's end overtakes results that are still on their way
CLOCK_GAP = 2.0  # seconds between ticks that mean a suspended host
SILENT_BEATS = 5
ABSENT_BEATS = 2
ANSWER_BEATS = 2  # after which a worker that was sent nothing hears that it is known
FORGOTTEN = 600.0  # seconds of silence after which a worker must say hello again
VISIT = 60.0  # the same for one that was welcomed and has not beaten yet: a guest
MOST_GUESTS = 256
MOST_FAILED = 16  # workers that a job's failures are remembered of; two pause the run
ATTEMPTS = 3  # of a failing job on one worker, where there is no other
MOST_RECORDS = 4096  # of hosts, those that joined last


@dataclass
class Wanted:
    """A job without a result."""

    work: Work
    order: int
    queued: bool = False  # whether the queue names it, so that it does so once whatever its workers do
    holders: set[str] = field(default_factory=set)
    failed: dict[str, str] = field(default_factory=dict)  # worker -> error
    attempts: Counter[str] = field(default_factory=Counter)  # worker -> how often it failed there

    @property
    def in_slack(self) -> bool:
        """Whether it fills what scoring leaves idle, and has a share of what it does not."""
        return self.work.job.kind != "score"


@dataclass(frozen=True)
class Send:
    """A numbered batch for one worker; 0 is an empty one that only says that the worker is known."""

    identity: str
    number: int
    content: Content


class Fleet:
    """The workers of one run and the jobs between them."""

    def __init__(self, beat: float, evaluation_share: float = 0.25) -> None:
        self._beat = beat
        self._wanted: dict[bytes, Wanted] = {}
        self._tags: dict[bytes, bytes] = {}
        self._queue: list[tuple[int, bytes]] = []  # what is scored, in order of offer
        self._spare: list[tuple[int, bytes]] = []  # what waits for slack or for its share
        self._share = Share(evaluation_share)
        self._orders = 0
        self._in_slack = 0  # evaluations and collected rollouts that somebody holds
        self._failing: dict[bytes, Wanted] = {}  # those of the wanted that failed somewhere
        self._accepted: dict[bytes, int] = {}  # digest -> generation, of this one and the last
        self._tail = Tail(beat)
        self._ticked: float | None = None
        self._now = 0.0  # of what is being handled
        self._records: dict[str, HostRecord] = {}  # by name of a host, the one that joined last at the end
        self._guests: dict[str, None] = {}  # identities, oldest first
        self.members: dict[str, Member] = {}
        self.counts: Counter[str] = Counter()
        self.notes: list[str] = []  # what happened, for whoever writes it down and clears it
        self.hurry = False  # nothing but evaluations and collected rollouts is left to wait for
        self.paused = False

    def offer(self, work: Iterable[Work]) -> None:
        """Want these jobs; jobs of generations before the last are forgotten."""
        for each in work:
            digest = each.job.digest
            if digest in self._wanted or digest in self._accepted:
                continue
            self._wanted[digest] = Wanted(each, self._orders)
            self._tags[digest[:TAG_BYTES]] = digest
            self._orders += 1
            self._enqueue(digest)

    def withdraw(self, kind: Kind) -> None:
        """No longer want jobs of this kind; what runs already becomes obsolete."""
        for digest, wanted in list(self._wanted.items()):
            if wanted.work.job.kind == kind:
                self._unwant(digest)

    def begin(self, generation: int) -> None:
        """A generation opens: copies from before the last one are obsolete."""
        self._accepted = {digest: number for digest, number in self._accepted.items() if number >= generation - 1}

    def welcome(self, identity: str, slots: int, fingerprint: str, now: float) -> None:
        """A worker was admitted; it has credit from its first beat on, and until then it is one of a few guests."""
        old = self.members.get(identity)
        if old is not None:
            self._forget(old)
        if len(self._guests) >= MOST_GUESTS:
            self._forget(self.members[next(iter(self._guests))])
        self._guests[identity] = None
        slots, born = min(slots, MOST_SLOTS), now if old is None else old.born
        self.members[identity] = Member(identity, slots, fingerprint, now, born, self._recall_record(identity, old))

    def depart(self, identity: str, now: float) -> None:
        """A worker's token vanished."""
        if (member := self.members.get(identity)) and member.lost is None:
            member.lost = now

    def dismiss(self, identity: str) -> None:
        """Forget a worker; others get its jobs, and what it says counts no more until it is welcomed again."""
        if member := self.members.get(identity):
            self._forget(member)

    def beat(self, identity: str, beat: Beat, now: float) -> None:
        """Reconcile what the worker holds with what it was given."""
        member = self.members.get(identity)
        if member is None:
            return
        self._hear(member, now)
        self._guests.pop(identity, None)
        if beat.seen > member.number:
            self._count_on(member, beat.seen)
        member.observe(beat, now)
        running = {self._tags.get(run.tag): run.steps for run in beat.running}
        shown = {self._tags.get(tag) for tag in (*beat.queued, *beat.unacked)} | running.keys()
        for digest, lease in list(member.leases.items()):
            lease.absent = 0 if digest in shown or lease.batch > beat.seen else lease.absent + 1
            lease.steps, lease.told = running.get(digest), now
            if lease.absent >= ABSENT_BEATS:
                self._drop_lease(member, digest)
        held = Handful(now, len(member.leases), alone=False)
        for found in shown - member.leases.keys():
            if found in self._wanted and len(self._wanted[found].holders) < 2:
                self._take(member, found, Lease(beat.seen, held, steps=running.get(found), told=now))
        member.lose_before(max((lease.batch for each, lease in member.leases.items() if each in shown), default=0))

    def result(self, identity: str, result: Result, now: float) -> tuple[VerdictWord, Work | None]:
        """Judge one result; the work comes back when it is the first wanted one, for the journal."""
        member, self._now = self.members.get(identity), now
        if member is not None:
            self._hear(member, now)
            member.take_back(result)
        verdict, work = self._judge(identity, result)
        if member is not None:
            member.leases.pop(result.digest, None)
            if member.known or len(member.verdicts) < MOST_GUESTS:
                member.verdicts.append(Verdict(result.digest, verdict))
            member.finished += verdict == "accepted"
        if verdict == "accepted":
            self._tail.learn(result.steps)
        self.counts["accepted_steps" if verdict == "accepted" else "discarded_steps"] += result.steps
        self.counts[verdict] += 1
        return verdict, work

    def wants(self, digest: bytes) -> Work | None:
        """The work of a wanted job."""
        wanted = self._wanted.get(digest)
        return None if wanted is None else wanted.work

    def holds(self, identity: str, digest: bytes) -> bool:
        """Whether a worker holds a wanted job."""
        return digest in self._wanted and identity in self._wanted[digest].holders

    def put_off(self, identity: str, digest: bytes, now: float) -> None:
        """A result came whose upload is still on its way: no verdict yet, and the lease stays."""
        member = self.members.get(identity)
        if member is None:
            return
        self._hear(member, now)
        lease = member.leases.get(digest)
        if lease is not None and lease.ended is None:
            lease.ended = now

    def tick(self, now: float) -> None:
        """Let time pass: departures, silences, batches to send again."""
        gap = now - self._ticked if self._ticked is not None else 0.0
        self._ticked = now
        for member in list(self.members.values()):
            if gap > CLOCK_GAP:
                self._extend(member, gap)
            if member.lost is not None:
                if now - max(member.lost, member.heard) >= DEPARTURE_GRACE:
                    self._lose(member, now, "left")
                    self._forget(member)
            elif now - member.heard > (FORGOTTEN if member.known else VISIT):
                self._forget(member)
            elif not member.silent and now - member.heard > SILENT_BEATS * self._beat:
                member.silent = True
                self._lose(member, now, "is silent")
                self.counts["silences"] += 1

    def dispatch(self, now: float, *, durable: bool = True) -> list[Send]:
        """Batches to send now: verdicts, cancellations, jobs to credit, and what was not seen in time.

        Verdicts stay until everything so far is `durable`.
        """
        for member in self.members.values():
            member.learn(now)
        given = self._assign(now)
        if not self._queue and not self.paused:
            for move in self._tail.plan(self._wanted, self.members, given, now):
                self._apply(move, given, now)
        if not self.paused:
            for move in self._tail.trials(self._wanted, self.members, given.keys(), now):
                self._apply(move, given, now)
        sends: list[Send] = []
        for member in self.members.values():
            if member.lost is not None or not member.known:
                continue
            said = [*self._again(member, now), *self._news(member, given.get(member.identity, ()), durable, now)]
            if not said and member.awaits_word(now, ANSWER_BEATS * self._beat):
                said = [Send(member.identity, 0, Content())]
            member.spoken = now if said else member.spoken
            sends += said
        return sends

    @property
    def open(self) -> int:
        """Jobs that are wanted."""
        return len(self._wanted)

    @property
    def leased(self) -> int:
        """Jobs in workers' hands, copies counted."""
        return sum(len(member.leases) for member in self.members.values())

    @property
    def failures(self) -> list[Failure]:
        """Wanted jobs that failed somewhere."""
        return [_failure(wanted) for wanted in self._failing.values()]

    def poison(self) -> Failure | None:
        """A job that failed on two different workers, or again and again on the only one there is."""
        for wanted in self._failing.values():
            if len(wanted.failed) > 1 or any(count >= ATTEMPTS for count in wanted.attempts.values()):
                return _failure(wanted)
        return None

    def pardon(self) -> None:
        """Forget what failed."""
        for wanted in self._failing.values():
            wanted.failed.clear()
            wanted.attempts.clear()
        self._failing.clear()

    def _again(self, member: Member, now: float) -> Iterator[Send]:
        """Batches that were not seen in time."""
        for number in [] if member.silent else member.overdue(now, 2 * self._beat):
            sent = member.unseen[number]
            sent.at, sent.times = now, sent.times + 1
            self.counts["resent_batches"] += 1
            yield Send(member.identity, number, sent.content)

    def _news(self, member: Member, given: Sequence[Work], durable: bool, now: float) -> Iterator[Send]:
        """Batches that it was not sent yet."""
        handful = member.give(now)
        for content in pack(given, member.cancels, member.verdicts if durable else []):
            member.number += 1
            member.unseen[member.number] = Sent(content, now, now)
            for work in content.work:
                self._take(member, work.job.digest, Lease(member.number, handful))
            yield Send(member.identity, member.number, content)
        member.cancels = []
        if durable:
            member.verdicts = []

    def _judge(self, identity: str, result: Result) -> tuple[VerdictWord, Work | None]:
        wanted = self._wanted.get(result.digest)
        if wanted is None:
            return ("duplicate" if result.digest in self._accepted else "obsolete"), None
        if result.fitness is None:
            self._failing[result.digest] = wanted
            if identity in wanted.failed or len(wanted.failed) < MOST_FAILED:
                wanted.attempts[identity] += 1
                wanted.failed[identity] = result.error or "no fitness and no reason"
            self.counts["errors"] += 1
            if member := self.members.get(identity):
                self._drop_lease(member, result.digest)
            return "refused", None
        self._share.count(result.digest, result.seconds, in_slack=wanted.in_slack, waiting=bool(self._spare))
        self._unhold(wanted, identity)
        self._unwant(result.digest)
        self._accepted[result.digest] = wanted.work.job.generation
        return "accepted", wanted.work

    def _unwant(self, digest: bytes) -> None:
        wanted = self._wanted.pop(digest)
        self._failing.pop(digest, None)
        self._tags.pop(digest[:TAG_BYTES], None)
        self._share.give_back(digest)
        for holder in list(wanted.holders):
            member = self.members[holder]
            lease = member.leases.pop(digest, None)
            self._unhold(wanted, holder)
            if lease is not None:
                member.overtaken(lease, self._now)
            if digest not in member.trials:  # which is worth its end
                member.cancels.append(digest)
            self.counts["discarded_steps"] += (lease and lease.steps) or 0

    def _hear(self, member: Member, now: float) -> None:
        member.heard = now
        member.silent = False

    def _extend(self, member: Member, gap: float) -> None:
        """A suspended host's gap is nobody's silence."""
        member.heard += gap
        for sent in member.unseen.values():
            sent.at += gap
        member.put_off(gap)

    def _count_on(self, member: Member, seen: int) -> None:
        """It counts batches as of before its last hello, whose answer it did not hear: what it is given follows on."""
        self._release(member)
        member.number = seen

    def _recall_record(self, identity: str, old: Member | None) -> HostRecord:
        """What is known of this worker's host, which every life of it goes on from."""
        name = identity.partition("/")[0]
        last = self._records.pop(name, None)
        record = old.record if old else last.inherit() if last else HostRecord()
        self._records[name] = record
        while len(self._records) > MOST_RECORDS:
            del self._records[next(iter(self._records))]
        return record

    def _lose(self, member: Member, now: float, what: str) -> None:
        if not member.known:
            return  # nothing was given to it, and no log should grow with what strangers call themselves
        self.notes.append(f"worker {member.identity} {what}: {len(member.leases)} jobs are free again")
        if member.leases:
            last = self._records.get(member.identity.partition("/")[0], member.record)
            last.die(now - member.born)
        self._release(member)

    def _take(self, member: Member, digest: bytes, lease: Lease) -> None:
        lease.in_slack = self._wanted[digest].in_slack
        member.leases[digest] = lease
        self._hold(self._wanted[digest], member.identity)

    def _hold(self, wanted: Wanted, identity: str) -> None:
        self._in_slack += wanted.in_slack and not wanted.holders
        wanted.holders.add(identity)

    def _unhold(self, wanted: Wanted, identity: str) -> None:
        if identity in wanted.holders:
            wanted.holders.discard(identity)
            self._in_slack -= wanted.in_slack and not wanted.holders

    def _apply(self, move: Move, given: dict[str, list[Work]], now: float) -> None:
        """Give a job to an idle slot too, or instead of to a worker that has not begun it."""
        wanted = self._wanted[move.digest]
        if move.instead_of:
            donor = self.members[move.instead_of]
            donor.leases.pop(move.digest)
            donor.cancels.append(move.digest)
            self._unhold(wanted, donor.identity)
        if move.trial:
            self.members[move.to].trials[move.digest] = Handful(now, 0)
        self.counts["recalled" if move.instead_of else "copied"] += 1
        self._hold(wanted, move.to)
        given.setdefault(move.to, []).append(wanted.work)

    def _drop_lease(self, member: Member, digest: bytes) -> None:
        """End a lease without a result; the job is queued again unless another worker holds it."""
        member.leases.pop(digest, None)
        wanted = self._wanted.get(digest)
        if wanted is None or member.identity not in wanted.holders:
            return
        self._unhold(wanted, member.identity)
        if not wanted.holders:
            self.counts["reissued"] += 1
            self._enqueue(digest)

    def _forget(self, member: Member) -> None:
        """It is nobody's member any more; one that lives says hello again, for it is silent to it in turn."""
        self._release(member)
        self._guests.pop(member.identity, None)
        del self.members[member.identity]

    def _release(self, member: Member) -> None:
        for digest in list(member.leases):
            self._drop_lease(member, digest)
        member.unseen.clear()
        member.trials.clear()

    def _enqueue(self, digest: bytes) -> None:
        wanted = self._wanted[digest]
        self._share.give_back(digest)
        if not wanted.queued:
            wanted.queued = True
            heapq.heappush(self._spare if wanted.in_slack else self._queue, (wanted.order, digest))

    def _assign(self, now: float) -> dict[str, list[Work]]:
        """One job at a time to the least loaded worker with credit that helps, so that a tail is spread evenly."""
        given: dict[str, list[Work]] = {}
        if self.paused:
            return given
        loads = {name: len(member.leases) for name, member in self.members.items() if member.credit > 0}
        choice = Choice(self.members, loads, len(self._queue), now)
        passed_over = []
        while loads and (turn := self._turn(loads)) is not None:
            queue, by_share = turn
            _, digest = heapq.heappop(queue)
            wanted = self._wanted.get(digest)
            if wanted is None:
                continue  # answered meanwhile
            wanted.queued = False
            if wanted.holders:
                continue  # adopted again from a worker that came back
            able = self._able(wanted, loads)
            if not able:
                passed_over.append(digest)
                continue
            name = choice.pick(able)
            if name is None and not wanted.failed:
                passed_over.append(digest)
                break  # nor the jobs after it: they had better wait for whoever is sooner
            name = name or min(able, key=lambda name: loads[name])
            choice.take(name)
            if by_share:
                self._share.take(digest)
            given.setdefault(name, []).append(wanted.work)
            self._hold(wanted, name)
            loads[name] += 1
            if len(given[name]) >= self.members[name].credit:
                del loads[name]
        for digest in passed_over:
            self._enqueue(digest)
        return given

    def _able(self, wanted: Wanted, loads: Mapping[str, int]) -> list[str]:
        """Who of these may be given this job: not where it failed, unless nobody else is there or about to be.

        A killed child must not hang a run, nor may a stranger who only said hello.
        """
        able = [name for name in loads if name not in wanted.failed]
        there = (name for name, member in self.members.items() if member.present and member.known)
        return list(loads) if not able and all(name in wanted.failed for name in there) else able

    def _turn(self, loads: Mapping[str, int]) -> tuple[list[tuple[int, bytes]], bool] | None:
        """The queue that gives the next job, and whether that job goes by its share; `None` where none may go."""
        helping = (member for member in self.members.values() if member.present and member.capacity)
        slots = sum(member.slots for member in helping) if self._spare else 0
        if self._queue:
            by_share = bool(self._spare) and self._share.due(slots)
            return (self._spare, True) if by_share else (self._queue, False)
        idle = any(load < self.members[name].capacity for name, load in loads.items())
        most = max(1, int(slots * self._share.share))  # more in idle slots would keep the next generation waiting
        if self._spare and (self.hurry or (idle and self._in_slack < most)):
            return self._spare, False
        return None


def _failure(wanted: Wanted) -> Failure:
    return Failure(wanted.work, dict(wanted.failed), dict(wanted.attempts))
