"""Who works on what: credits, leases, losses, verdicts. Pure: events and a clock in, batches out.

No message is trusted to arrive. A batch is kept until its worker has seen it; a job is wanted until its first valid
result; what a beat does not show is dispatched again. Rules 2, 3, 5, 6 and 7 of the protocol.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from common.messages import MAX_LEASES, TAG_BYTES, Beat, Kind, Result, Verdict, VerdictWord
from coordinator.jobs import Work
from coordinator.packing import Content, pack

DEPARTURE_GRACE = 0.05  # seconds: a token's end overtakes results that are still on their way
CLOCK_GAP = 2.0  # seconds between ticks that mean a suspended host
SILENT_BEATS = 5
ABSENT_BEATS = 2


@dataclass
class Lease:
    """A job in a worker's hands."""

    batch: int
    absent: int = 0  # beats in a row that have seen the batch and do not show the job


@dataclass
class Sent:
    """A batch that its worker has not confirmed."""

    content: Content
    at: float


@dataclass
class Member:
    """What the coordinator believes of one worker."""

    identity: str
    slots: int
    fingerprint: str
    heard: float
    capacity: int = 0  # unknown, and so without credit, before its first beat
    lost: float | None = None
    silent: bool = False
    number: int = 0
    seen: int = 0
    load: float = 0.0
    steps_per_second: float = 0.0
    drawn_by: str = "-"
    finished: int = 0
    leases: dict[bytes, Lease] = field(default_factory=dict)
    unseen: dict[int, Sent] = field(default_factory=dict)
    verdicts: list[Verdict] = field(default_factory=list)
    cancels: list[bytes] = field(default_factory=list)

    @property
    def present(self) -> bool:
        """Whether it may be given work."""
        return self.lost is None and not self.silent

    @property
    def credit(self) -> int:
        """How many more jobs it may be given."""
        return min(2 * self.capacity, MAX_LEASES) - len(self.leases) if self.present else 0


@dataclass
class Wanted:
    """A job without a result."""

    work: Work
    order: int
    holders: set[str] = field(default_factory=set)
    failed: dict[str, str] = field(default_factory=dict)  # worker -> error


@dataclass(frozen=True)
class Send:
    """A numbered batch for one worker."""

    identity: str
    number: int
    content: Content


class Fleet:
    """The workers of one run and the jobs between them."""

    def __init__(self, beat: float) -> None:
        self._beat = beat
        self._wanted: dict[bytes, Wanted] = {}
        self._tags: dict[bytes, bytes] = {}
        self._queue: list[tuple[bool, int, bytes]] = []  # evaluations last, then in order of offer
        self._orders = 0
        self._accepted: dict[bytes, int] = {}  # digest -> generation, of this one and the last
        self._ticked: float | None = None
        self.members: dict[str, Member] = {}
        self.counts: Counter[str] = Counter()
        self.hurry = False  # nothing but evaluations is left to wait for
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

    def forget(self, before: int) -> None:
        """Drop the memory of accepted results of generations below `before`; late copies are then obsolete."""
        self._accepted = {digest: number for digest, number in self._accepted.items() if number >= before}

    def welcome(self, identity: str, slots: int, fingerprint: str, now: float) -> None:
        """A worker was admitted; it has credit from its first beat on."""
        old = self.members.get(identity)
        if old is not None:
            self._release(old)
        self.members[identity] = Member(identity, slots, fingerprint, heard=now)

    def depart(self, identity: str, now: float) -> None:
        """A worker's token vanished."""
        if (member := self.members.get(identity)) and member.lost is None:
            member.lost = now

    def beat(self, identity: str, beat: Beat, now: float) -> None:
        """Reconcile what the worker holds with what it was given."""
        member = self.members.get(identity)
        if member is None:
            return
        self._hear(member, now)
        member.capacity, member.slots, member.seen = beat.capacity, beat.slots, beat.seen
        member.load, member.steps_per_second, member.drawn_by = beat.load, beat.steps_per_second, beat.drawn_by
        member.unseen = {number: sent for number, sent in member.unseen.items() if number > beat.seen}
        shown = {self._tags.get(tag) for tag in (*beat.queued, *(run.tag for run in beat.running), *beat.unacked)}
        for digest, lease in list(member.leases.items()):
            lease.absent = 0 if digest in shown or lease.batch > beat.seen else lease.absent + 1
            if lease.absent >= ABSENT_BEATS:
                self._drop_lease(member, digest)
        for found in shown - member.leases.keys():
            if found in self._wanted and len(self._wanted[found].holders) < 2:
                self._take(member, found, Lease(beat.seen))

    def result(self, identity: str, result: Result, now: float) -> tuple[VerdictWord, Work | None]:
        """Judge one result; the work comes back when it is the first wanted one, for the journal."""
        member = self.members.get(identity)
        if member is not None:
            self._hear(member, now)
        verdict, work = self._judge(identity, result)
        if member is not None:
            member.leases.pop(result.digest, None)
            member.verdicts.append(Verdict(result.digest, verdict))
            member.finished += verdict == "accepted"
        self.counts["accepted_steps" if verdict == "accepted" else "discarded_steps"] += result.steps
        self.counts[verdict] += 1
        return verdict, work

    def tick(self, now: float) -> None:
        """Let time pass: departures, silences, batches to send again."""
        gap = now - self._ticked if self._ticked is not None else 0.0
        self._ticked = now
        for member in list(self.members.values()):
            if gap > CLOCK_GAP:
                self._extend(member, gap)
            if member.lost is not None:
                if now - max(member.lost, member.heard) >= DEPARTURE_GRACE:
                    self._release(member)
                    del self.members[member.identity]
            elif not member.silent and now - member.heard > SILENT_BEATS * self._beat:
                member.silent = True
                self.counts["silences"] += 1
                self._release(member)

    def dispatch(self, now: float) -> list[Send]:
        """Batches to send now: verdicts, cancellations, jobs to credit, and what was not seen in time."""
        given = self._assign()
        sends = []
        for member in self.members.values():
            if member.lost is not None:
                continue
            for number, sent in member.unseen.items():
                if now - sent.at > 2 * self._beat and not member.silent:
                    sent.at = now
                    self.counts["resent_batches"] += 1
                    sends.append(Send(member.identity, number, sent.content))
            for content in pack(given.get(member.identity, []), member.cancels, member.verdicts):
                member.number += 1
                member.unseen[member.number] = Sent(content, now)
                for work in content.work:
                    self._take(member, work.job.digest, Lease(member.number))
                sends.append(Send(member.identity, member.number, content))
            member.cancels, member.verdicts = [], []
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
    def failures(self) -> list[tuple[Work, dict[str, str]]]:
        """Wanted jobs that failed somewhere, with each worker's error."""
        return [(wanted.work, dict(wanted.failed)) for wanted in self._wanted.values() if wanted.failed]

    def poison(self) -> tuple[Work, dict[str, str]] | None:
        """A job that failed on two different workers."""
        return next(((work, failed) for work, failed in self.failures if len(failed) > 1), None)

    def _judge(self, identity: str, result: Result) -> tuple[VerdictWord, Work | None]:
        wanted = self._wanted.get(result.digest)
        if wanted is None:
            return ("duplicate" if result.digest in self._accepted else "obsolete"), None
        if result.fitness is None:
            wanted.failed[identity] = result.error or "no fitness and no reason"
            self.counts["errors"] += 1
            if member := self.members.get(identity):
                self._drop_lease(member, result.digest)
            return "refused", None
        wanted.holders.discard(identity)
        self._unwant(result.digest)
        self._accepted[result.digest] = wanted.work.job.generation
        return "accepted", wanted.work

    def _unwant(self, digest: bytes) -> None:
        wanted = self._wanted.pop(digest)
        self._tags.pop(digest[:TAG_BYTES], None)
        for holder in wanted.holders:
            self.members[holder].leases.pop(digest, None)
            self.members[holder].cancels.append(digest)

    def _hear(self, member: Member, now: float) -> None:
        member.heard = now
        member.silent = False

    def _extend(self, member: Member, gap: float) -> None:
        """A suspended host's gap is nobody's silence."""
        member.heard += gap
        for sent in member.unseen.values():
            sent.at += gap

    def _take(self, member: Member, digest: bytes, lease: Lease) -> None:
        member.leases[digest] = lease
        self._wanted[digest].holders.add(member.identity)

    def _drop_lease(self, member: Member, digest: bytes) -> None:
        """End a lease without a result; the job is queued again unless another worker holds it."""
        member.leases.pop(digest, None)
        wanted = self._wanted.get(digest)
        if wanted is None or member.identity not in wanted.holders:
            return
        wanted.holders.discard(member.identity)
        if not wanted.holders:
            self.counts["reissued"] += 1
            self._enqueue(digest)

    def _release(self, member: Member) -> None:
        for digest in list(member.leases):
            self._drop_lease(member, digest)
        member.unseen.clear()

    def _enqueue(self, digest: bytes) -> None:
        wanted = self._wanted[digest]
        heapq.heappush(self._queue, (wanted.work.job.kind == "evaluate", wanted.order, digest))

    def _assign(self) -> dict[str, list[Work]]:
        """One job at a time to the least loaded worker with credit, so that a generation's tail is spread evenly."""
        given: dict[str, list[Work]] = {}
        if self.paused:
            return given
        loads = {name: len(member.leases) for name, member in self.members.items() if member.credit > 0}
        evaluating = sum(
            wanted.work.job.kind == "evaluate" and bool(wanted.holders) for wanted in self._wanted.values()
        )
        passed_over = []
        while self._queue and loads:
            entry = heapq.heappop(self._queue)
            wanted = self._wanted.get(entry[2])
            if wanted is None or wanted.holders:
                continue  # answered meanwhile, or adopted again from a worker that came back
            if entry[0] and not self.hurry and evaluating >= self._evaluation_slots():
                passed_over.append(entry)
                break  # evaluations are last in the queue
            able = [name for name in loads if name not in wanted.failed]
            if not able:
                passed_over.append(entry)
                continue
            name = min(able, key=lambda name: loads[name] / self.members[name].capacity)
            given.setdefault(name, []).append(wanted.work)
            wanted.holders.add(name)
            evaluating += entry[0]
            loads[name] += 1
            if len(given[name]) >= self.members[name].credit:
                del loads[name]
        for entry in passed_over:
            heapq.heappush(self._queue, entry)
        return given

    def _evaluation_slots(self) -> int:
        """Evaluations of a mean fill the tail of a generation and never more than a quarter of the slots."""
        return max(1, sum(member.capacity for member in self.members.values() if member.present) // 4)
