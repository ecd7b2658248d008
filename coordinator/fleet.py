"""Who works on what: credits, leases, losses, verdicts. Pure: events and a clock in, batches out.

No message is trusted to arrive. A batch is kept until its worker has seen it; a job is wanted until its first valid
result; what a beat does not show is dispatched again. Rules 2, 3, 5, 6, 7 and 8 of the protocol.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from dreamfleet.common.messages import MOST_SLOTS, Beat, Kind, Result, Verdict, VerdictWord
from dreamfleet.common.printable import plural
from dreamfleet.common.status import What
from dreamfleet.coordinator.choice import Choice
from dreamfleet.coordinator.jobs import Work
from dreamfleet.coordinator.member import Handful, Lease, Member, Sent
from dreamfleet.coordinator.packing import Content, pack
from dreamfleet.coordinator.record import HostRecord
from dreamfleet.coordinator.story import Story
from dreamfleet.coordinator.tail import Move, Tail
from dreamfleet.coordinator.wanted import Wanted, WantedJobs

DEPARTURE_GRACE = 0.05  # seconds: a token's end overtakes results that are still on their way
CLOCK_GAP = 2.0  # seconds between ticks that mean a suspended host
SILENT_BEATS = 5
ABSENT_BEATS = 2
LIVELY_BEATS = 2  # within which a worker has spoken that lives
ANSWER_BEATS = 2  # after which a worker that was sent nothing hears that it is known
FORGOTTEN = 600.0  # seconds of silence after which a worker must say hello again
VISIT = 60.0  # the same for one that was welcomed and has not beaten yet: a guest
MOST_GUESTS = 256
MISSED = 600.0  # seconds for which who vanished without a word is told as lost, unless he is back
MOST_LOST = 256  # of whom so many are told, those that vanished last
MOST_RECORDS = 4096  # of hosts, those that joined last


@dataclass(frozen=True)
class Send:
    """A numbered batch for one worker; 0 is an empty one that only says that the worker is known."""

    identity: str
    numbering: int
    number: int
    content: Content


class Fleet:
    """The workers of one run and the jobs between them."""

    def __init__(self, beat: float, evaluation_share: float = 0.25) -> None:
        self._beat = beat
        self._tail = Tail(beat)
        self._numberings = 0  # that were begun
        self._ticked: float | None = None
        self._now = 0.0  # of what is being handled
        self._records: dict[str, HostRecord] = {}  # by name of a host, the one that joined last at the end
        self._guests: dict[str, None] = {}  # identities, oldest first
        self.lost: dict[str, Member] = {}  # who vanished without a word, the last one at the end; told, no more
        self.jobs = WantedJobs(evaluation_share)
        self.members: dict[str, Member] = {}
        self.counts: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()  # what was not believed, by reason
        self.story = Story()  # of workers and jobs, for whoever asks
        self.notes: list[str] = []  # what happened, for whoever writes it down and clears it
        self.hurry = False  # nothing but evaluations and collected rollouts is left to wait for
        self.paused = False
        self.alone = False  # what is scored now, a slot does by itself, however wide the run's task is

    def withdraw(self, kind: Kind) -> None:
        """No longer want jobs of this kind; what runs already becomes obsolete."""
        for digest in self.jobs.of_kind(kind):
            self._cancel(digest, self.jobs.remove(digest))

    def welcome(self, identity: str, slots: int, fingerprint: str, now: float) -> int:
        """A worker was admitted; it has credit from its first beat on, and until then it is one of a few guests.

        Its batches are counted anew, under the number that is returned. But a hello in the name of one that beats
        changes nothing: the worker is told what it missed, and a stranger who greets as somebody else takes nothing.
        """
        old = self.members.get(identity)
        if old is not None and old.known and old.present and now - old.heard <= LIVELY_BEATS * self._beat:
            old.send_again(now - self._beat)
            return old.numbering
        if old is not None:
            self._forget(old)
        if len(self._guests) >= MOST_GUESTS:
            self._forget(self.members[next(iter(self._guests))])
        self._guests[identity] = None
        slots, born = min(slots, MOST_SLOTS), now if old is None else old.born
        record = self._recall_record(identity, old)
        member = Member(identity, slots, fingerprint, self._next_numbering(), now, born, record)
        self.members[identity] = member
        return member.numbering

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
        member, self._now = self.members.get(identity), now
        if member is None:
            return
        self._hear(member, now)
        if identity in self._guests:  # until it has beaten it may be anybody, and strangers would fill the story
            del self._guests[identity]
            self.story.add(now, "back" if identity in self.lost else "joined", identity)
            self._find(identity)
        if beat.numbering != member.numbering:
            # It was late, or its worker has not heard of the welcome: what it had queued, it will then forget.
            beat = replace(beat, seen=0, queued=())
        elif beat.seen > member.number:  # somebody else sent batches in this coordinator's name: they are counted anew
            self._begin_anew(member)
            self.dropped["count of batches"] += 1
            beat = replace(beat, seen=0, queued=())
        if self.alone:
            beat = replace(beat, capacity=min(beat.capacity, beat.slots))
        for sent in member.observe(beat, now):
            for work in sent.content.work:
                self.story.add(now, "seen", identity, work.job.digest)
        running = {self.jobs.named(run.tag): run.steps for run in beat.running}
        shown = {self.jobs.named(tag) for tag in (*beat.queued, *beat.unacked)} | running.keys()
        for digest, lease in list(member.leases.items()):
            lease.absent = 0 if digest in shown or lease.batch > beat.seen else lease.absent + 1
            lease.steps, lease.told = running.get(digest), now
            if lease.absent >= ABSENT_BEATS:
                self._drop_lease(member, digest)
        held = Handful(now, len(member.leases), alone=False)
        for found in shown - member.leases.keys():
            if found is not None and self._may_take_up(found, identity):
                self._take(member, found, Lease(beat.seen, held, steps=running.get(found), told=now))
        member.lose_before(max((lease.batch for each, lease in member.leases.items() if each in shown), default=0))

    def result(self, identity: str, result: Result, now: float) -> tuple[VerdictWord, Work | None]:
        """Judge one result; the work comes back when it is the first wanted one, for the journal."""
        member, self._now = self.members.get(identity), now
        if self.asked_of(identity, result) is None and (member is None or not member.known):
            self.dropped["result of a stranger"] += 1  # who says it again once the run knows him
            return "refused", None
        if member is not None:
            self._hear(member, now)
            member.take_back(result)
        lease = None if member is None else member.leases.get(result.digest)
        verdict, work = self._judge(identity, result)
        if lease is not None and work is not None:
            self._tail.took(now - lease.handful.given, in_slack=lease.in_slack)
        if member is not None or verdict == "accepted":
            self.story.add(now, verdict, identity, result.digest)
        if member is not None:
            member.leases.pop(result.digest, None)
            member.verdicts.append(Verdict(result.digest, verdict))
            member.finished += verdict == "accepted"
            if work is not None:
                member.record.took(work.job.kind, result.seconds)
        if verdict == "accepted":
            self._tail.learn(result.steps)
        self.counts["accepted_steps" if verdict == "accepted" else "discarded_steps"] += result.steps
        self.counts[verdict] += 1
        return verdict, work

    def asked_of(self, identity: str, result: Result) -> Work | None:
        """The wanted job of which this worker may bring this result; `None` where there is none.

        It brings what it was given in this life of the coordinator, whether or not it still holds the lease. What an
        earlier life may have given counts from any worker that has been welcomed and has beaten, for nobody knows
        whom it was given to. A failure counts only from who holds the lease.
        """
        wanted, member = self.jobs.get(result.digest), self.members.get(identity)
        if wanted is None or not self.jobs.may_have(result.digest, identity):
            return None
        known = identity in wanted.given or (member is not None and member.known)
        return wanted.work if known and (result.fitness is not None or identity in wanted.holders) else None

    def overrun(self, identity: str, digest: bytes) -> None:
        """A worker tells more steps of a job than it can have: it had better be scored elsewhere."""
        if (member := self.members.get(identity)) and digest in member.leases:
            self.dropped["lease with more steps than a job has"] += 1
            self.jobs.overrun(digest, identity)
            member.cancels.append(digest)
            self._drop_lease(member, digest)

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
        self._ticked = self._now = now
        self.lost = {name: each for name, each in self.lost.items() if now - each.heard <= MISSED}
        for member in list(self.members.values()):
            if gap > CLOCK_GAP:
                self._extend(member, gap)
            if member.lost is not None:
                if now - max(member.lost, member.heard) >= DEPARTURE_GRACE:
                    self._lose(member, now, "is gone without a word" if member.capacity else "left")
                    self._forget(member)
                    self._miss(member)
            elif now - member.heard > (FORGOTTEN if member.known else VISIT):
                self._forget(member)
            elif not member.silent and now - member.heard > SILENT_BEATS * self._beat:
                member.silent = True
                self._lose(member, now, "is silent")
                self._begin_anew(member)  # what it has not seen is not sent again
                self.counts["silences"] += 1

    def dispatch(self, now: float, *, durable: bool = True) -> list[Send]:
        """Batches to send now: verdicts, cancellations, jobs to credit, and what was not seen in time.

        Verdicts stay until everything so far is `durable`.
        """
        self._now = now
        for member in self.members.values():
            member.learn(now)
        given = self._assign(now)
        if not self.jobs.queued and not self.paused:
            for move in self._tail.plan(self.jobs, self.members, given, now):
                self._apply(move, given, now)
        if not self.paused:
            for move in self._tail.trials(self.jobs, self.members, given.keys(), now):
                self._apply(move, given, now)
        sends: list[Send] = []
        for member in self.members.values():
            if not (member.present and member.known):
                continue
            said = [*self._again(member, now), *self._news(member, given.get(member.identity, ()), durable, now)]
            if not said and member.awaits_word(now, ANSWER_BEATS * self._beat):
                said = [Send(member.identity, member.numbering, 0, Content())]
            member.spoken = now if said else member.spoken
            sends += said
        return sends

    @property
    def leased(self) -> int:
        """Jobs in workers' hands, copies counted."""
        return sum(len(member.leases) for member in self.members.values())

    def _again(self, member: Member, now: float) -> Iterator[Send]:
        """Batches that were not seen in time."""
        for number in member.overdue(now, 2 * self._beat):
            sent = member.unseen[number]
            sent.at, sent.times = now, sent.times + 1
            self.counts["resent_batches"] += 1
            member.resent += 1
            for work in sent.content.work:
                self.story.add(now, "sent again", member.identity, work.job.digest)
            yield Send(member.identity, member.numbering, number, sent.content)

    def _news(self, member: Member, given: Sequence[Work], durable: bool, now: float) -> Iterator[Send]:
        """Batches that it was not sent yet."""
        handful = member.give(now)
        for content in pack(given, member.cancels, member.verdicts if durable else []):
            member.number += 1
            member.unseen[member.number] = Sent(content, now, now)
            for work in content.work:
                self._take(member, work.job.digest, Lease(member.number, handful))
                self.story.give(now, member.identity, work.job)
            yield Send(member.identity, member.numbering, member.number, content)
        member.cancels = []
        if durable:
            member.verdicts = []

    def _judge(self, identity: str, result: Result) -> tuple[VerdictWord, Work | None]:
        if result.digest not in self.jobs:
            return ("duplicate" if self.jobs.is_accepted(result.digest) else "obsolete"), None
        if self.asked_of(identity, result) is None:
            self.dropped["result of a job that was not given"] += 1
            return "refused", None
        if result.fitness is None:
            self.jobs.fail(identity, result)
            self.counts["errors"] += 1
            if member := self.members.get(identity):
                self._drop_lease(member, result.digest)
            return "refused", None
        wanted = self.jobs.accept(result)
        wanted.holders.discard(identity)
        self._cancel(result.digest, wanted)
        return "accepted", wanted.work

    def _cancel(self, digest: bytes, wanted: Wanted) -> None:
        """Whoever holds a job that is wanted no more hears so."""
        for holder in wanted.holders:
            member = self.members[holder]
            lease = member.leases.pop(digest, None)
            if lease is not None:
                member.overtaken(lease, self._now)
            if digest not in member.trials:  # which is worth its end
                member.cancels.append(digest)
            self.counts["discarded_steps"] += (lease and lease.steps) or 0

    def _may_take_up(self, digest: bytes, identity: str) -> bool:
        """Whether a worker that shows a wanted job has its lease again."""
        wanted = self.jobs[digest]
        free = len(wanted.holders) < 2 and identity not in wanted.overrun
        return free and self.jobs.may_have(digest, identity)

    def _begin_anew(self, member: Member) -> None:
        """Whatever a worker has is given again, in another numbering, unless it shows it."""
        self._release(member)
        member.begin_numbering(self._next_numbering())

    def _next_numbering(self) -> int:
        self._numberings += 1
        return self._numberings

    def _hear(self, member: Member, now: float) -> None:
        member.heard = now
        if member.silent and member.known:  # else its silence was not told either
            self.story.add(now, "back", member.identity)
        member.silent = False

    def _extend(self, member: Member, gap: float) -> None:
        """A suspended host's gap is nobody's silence."""
        member.heard += gap
        for sent in member.unseen.values():
            sent.at += gap
        member.put_off(gap)

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
        freed = f"{plural(len(member.leases), 'job')} {'is' if len(member.leases) == 1 else 'are'} free again"
        self.notes.append(f"worker {member.identity} {what}: {freed}")
        gone: What = "lost" if member.capacity else "left"
        self.story.add(now, "silent" if member.lost is None else gone, member.identity)
        if member.leases:
            last = self._records.get(member.identity.partition("/")[0], member.record)
            last.die(now - member.born)
        self._release(member)

    def _take(self, member: Member, digest: bytes, lease: Lease) -> None:
        lease.in_slack = self.jobs[digest].in_slack
        member.leases[digest] = lease
        self.jobs.hold(digest, member.identity)

    def _apply(self, move: Move, given: dict[str, list[Work]], now: float) -> None:
        """Give a job to an idle slot too, or instead of to a worker that has not begun it."""
        if move.instead_of:
            donor = self.members[move.instead_of]
            donor.leases.pop(move.digest)
            donor.cancels.append(move.digest)
            self.jobs.let_go(move.digest, donor.identity)
            self.story.add(now, "recalled", donor.identity, move.digest)
        else:
            self.story.add(now, "copied", move.to, move.digest)
        if move.trial:
            self.members[move.to].trials[move.digest] = Handful(now, 0)
        self.counts["recalled" if move.instead_of else "copied"] += 1
        self.jobs.hold(move.digest, move.to)
        given.setdefault(move.to, []).append(self.jobs[move.digest].work)

    def _drop_lease(self, member: Member, digest: bytes) -> None:
        """End a lease without a result; the job is queued again unless another worker holds it."""
        member.leases.pop(digest, None)
        if self.jobs.let_go(digest, member.identity):
            self.counts["reissued"] += 1
            self.story.add(self._now, "reissued", member.identity, digest)
            self.jobs.enqueue(digest)

    def _forget(self, member: Member) -> None:
        """It is nobody's member any more; one that lives says hello again, for it is silent to it in turn."""
        self._release(member)
        self._guests.pop(member.identity, None)
        del self.members[member.identity]

    def _miss(self, member: Member) -> None:
        """Its token vanished. One that left had said that it takes no more; of any other it is told that it is lost."""
        if member.known and member.capacity:
            self.lost[member.identity] = member
            if len(self.lost) > MOST_LOST:
                del self.lost[next(iter(self.lost))]

    def _find(self, identity: str) -> None:
        """It is back, or another life of a lost worker of its host is there in its place."""
        host = identity.partition("/")[0]
        others = (name for name in self.lost if name.partition("/")[0] == host)
        self.lost.pop(identity if identity in self.lost else next(others, ""), None)

    def _release(self, member: Member) -> None:
        for digest in list(member.leases):
            self._drop_lease(member, digest)
        member.unseen.clear()
        member.trials.clear()

    def _assign(self, now: float) -> dict[str, list[Work]]:
        """One job at a time to the least loaded worker with credit that helps, so that a tail is spread evenly."""
        given: dict[str, list[Work]] = {}
        if self.paused:
            return given
        loads = {name: len(member.leases) for name, member in self.members.items() if member.credit > 0}
        choice = Choice(self.members, loads, self.jobs.queued, now)
        slots = sum(member.slots for member in self.members.values() if member.present and member.capacity)
        passed_over = []
        while loads:
            idle = any(load < self.members[name].capacity for name, load in loads.items())
            if (turn := self.jobs.next(slots, idle=idle, hurry=self.hurry)) is None:
                break
            wanted = self.jobs[turn.digest]
            able = self._able(wanted, loads)
            if not able:
                passed_over.append(turn.digest)
                continue
            name = choice.pick(able)
            if name is None and not wanted.shunned:
                passed_over.append(turn.digest)
                break  # nor the jobs after it: they had better wait for whoever is sooner
            name = name or min(able, key=lambda name: loads[name])
            choice.take(name)
            given.setdefault(name, []).append(wanted.work)
            self.jobs.hold(turn.digest, name, by_share=turn.by_share)
            loads[name] += 1
            if len(given[name]) >= self.members[name].credit:
                del loads[name]
        for digest in passed_over:
            self.jobs.enqueue(digest)
        return given

    def _able(self, wanted: Wanted, loads: Mapping[str, int]) -> list[str]:
        """Who of these may be given this job: not where it failed, unless nobody else is there or about to be.

        A killed child must not hang a run, nor may a stranger who only said hello.
        """
        able = [name for name in loads if name not in wanted.shunned]
        there = (name for name, member in self.members.items() if member.present and member.known)
        return list(loads) if not able and all(name in wanted.shunned for name in there) else able
