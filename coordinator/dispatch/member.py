"""What the coordinator knows of one worker: its state, leases, unconfirmed batches and speed. Pure."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, field
from enum import Enum, auto

from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.protocol.messages import MAX_LEASES, MAX_SIDE_BY_SIDE, Heartbeat, Job, Result, Verdict
from dreamfleet.coordinator.dispatch.host_stats import HostStats
from dreamfleet.coordinator.dispatch.packing import SentBatch

TRIAL_SECONDS = 60.0  # after which a trial copy without a result is forgotten
MAX_BACKOFF = 4  # doublings of the pause before a batch is sent again
MOST_VERDICTS = 16 * MAX_LEASES  # that wait for a heartbeat which confirms them: 2 MB, and a second of tiny jobs
ABSENT_HEARTBEATS = 2  # in a row that confirm a job's batch and do not list the job: its lease ends
DEPARTED_TIMEOUT = 600.0  # seconds for which a departed worker is listed, unless its host is back
MAX_DEPARTED = 256  # departed workers that are listed, the latest ones


class MemberState(Enum):
    """A member's state; one that departed is no member any more (`DepartedWorkers`)."""

    UNCONFIRMED = auto()  # welcomed, no heartbeat yet: anybody can say hello
    PRESENT = auto()
    SILENT = auto()  # no message for several intervals: it has no leases
    GONE = auto()  # its token vanished: results that are under way have a moment to arrive


@dataclass(eq=False)
class DispatchGroup:
    """Jobs that a worker was given at one moment; `returned_count` of them have come back."""

    given_at: float
    held_before: int
    returned_count: int = 0
    only_scoring: bool = True  # whether the worker held only candidates' jobs, so that the time measures its speed


@dataclass
class Lease:
    """A job that a worker holds: sent in `batch`, then running once a heartbeat shows its `steps`."""

    batch: int
    group: DispatchGroup
    is_background: bool = False  # its job evaluates or collects
    is_driven: bool = False
    absent_heartbeats: int = 0  # in a row that confirm the batch and do not list the job
    steps: int | None = None  # environment steps so far, once a heartbeat has shown the job running
    steps_seen_at: float = 0.0  # when the last heartbeat came
    finished: bool = False  # the last heartbeat listed its result, which has not come
    upload_pending_since: float | None = None  # when its result first came, while its upload is still on the way


@dataclass
class Member:
    """What the coordinator knows of one worker."""

    identity: str
    slots: int
    fingerprint: str
    numbering: int  # of its batches
    last_heard: float
    joined_at: float = 0.0
    host_stats: HostStats = field(default_factory=HostStats)
    # Candidates' jobs that it scores at once; 0, and so no credit, before the first heartbeat and once it drains.
    capacity: int = 0
    batch_size: int = 1  # candidates' jobs that one of its slots scores at once
    taken: int = 0  # of its capacity, what its other runs use now
    side_by_side: int = 1  # candidates' drives that one of its slots does side by side
    drives_per_slot: int = MAX_SIDE_BY_SIDE  # of these, as many as leave work for all slots; set before each dispatch
    gone_since: float | None = None  # when its token vanished, or its first heartbeat was its last
    farewell: str = ""  # why it leaves, by its last heartbeat
    silent: bool = False
    is_unconfirmed: bool = True  # until its first heartbeat
    number: int = 0  # of the last batch in its numbering
    confirmed: int = 0  # the worker has all batches up to this number
    load: float = 0.0
    steps_per_second: float = 0.0
    drawn_by: str = "-"
    host_class: str = ""  # empty: not known yet
    is_trusted: bool = False  # it has shown that it is on the coordinator's own host
    is_held: bool = False  # it differs from another host, and nobody has decided which of them is wrong
    finished: int = 0  # accepted results
    was_ready: bool = False  # some heartbeat named a slot that scores
    resent: int = 0  # batches that were sent again
    # By digest, in the order in which they were given; `add_lease` and `end_lease` change them.
    leases: dict[bytes, Lease] = field(default_factory=dict)
    held: Counter[tuple[bool, bool]] = field(default_factory=Counter)  # leases by `is_background`, `is_driven`
    held_at_silence: set[bytes] = field(default_factory=set)  # its jobs when it became silent
    trial_copies: dict[bytes, DispatchGroup] = field(default_factory=dict)  # copies that measure it, wanted or not
    returned: list[DispatchGroup] = field(default_factory=list)  # groups with a new result since the last dispatch
    last_delivery: float = 0.0  # when a heartbeat last confirmed a batch
    last_sent: float = 0.0  # when anything was last sent to it
    unconfirmed: dict[int, SentBatch] = field(default_factory=dict)
    verdicts: list[Verdict] = field(default_factory=list)  # to send
    unconfirmed_verdicts: int = 0  # to send, or sent in unconfirmed batches
    cancels: list[bytes] = field(default_factory=list)  # to send

    @property
    def state(self) -> MemberState:
        """Its state now."""
        if self.gone_since is not None:
            return MemberState.GONE
        if self.is_unconfirmed:
            return MemberState.UNCONFIRMED
        return MemberState.SILENT if self.silent else MemberState.PRESENT

    @property
    def has_been_ready(self) -> bool:
        """Whether it is present, not held back, and could take a job before; it may replace a scoring process now."""
        return self.state is MemberState.PRESENT and self.was_ready and not self.is_held

    @property
    def is_lost(self) -> bool:
        """Whether it is gone, and neither drained nor said why it leaves."""
        return self.gone_since is not None and self.capacity > 0 and not self.farewell

    @property
    def departure(self) -> str:
        """How it went, for the log."""
        if self.is_lost:
            return "is lost: it was killed, or its connection was cut"
        return f"left ({self.farewell})" if self.farewell else "left"

    @property
    def is_reachable(self) -> bool:
        """Whether it is present, or unconfirmed and was heard lately."""
        return self.gone_since is None and not self.silent

    @property
    def takes_jobs(self) -> bool:
        """Whether it is present and does not drain."""
        return self.can_score and not self.is_held

    @property
    def can_score(self) -> bool:
        """Whether it is present and does not drain, though it may be held back."""
        return self.is_reachable and self.capacity > 0

    @property
    def free_capacity(self) -> int:
        """How many jobs it scores at once now, beside those of its other runs."""
        return max(0, self.capacity - self.taken)

    @property
    def credit(self) -> int:
        """How many more jobs it may be given.

        R14: at most twice as many jobs as it scores at once, so it never waits and its loss costs little. A host that
        is held back gets only jobs that decide about it.
        """
        return 0 if self.is_held else self.check_credit

    @property
    def check_credit(self) -> int:
        """How many more jobs it may be given whose results are compared."""
        return min(2 * self.capacity, MAX_LEASES) - self.held_share if self.is_reachable else 0

    def share_of(self, job: Job) -> int:
        """How much of its `capacity` a job takes: one that runs alone takes a whole slot, a drive its part of one."""
        return self._share(job.is_background, bool(job.driven))

    def _share(self, is_background: bool, is_driven: bool) -> int:
        if is_background:
            return self.batch_size
        if not is_driven and self.batch_size > self.side_by_side:
            return 1
        return math.ceil(self.batch_size / min(self.side_by_side, self.drives_per_slot))

    @property
    def held_share(self) -> int:
        """How much of its `capacity` its leases take; more than all of it if some wait there."""
        if self.batch_size == 1:
            return len(self.leases)
        return sum(count * self._share(*kind) for kind, count in self.held.items())

    def add_lease(self, digest: bytes, lease: Lease) -> None:
        """Note that it is given a job."""
        self.end_lease(digest)
        self.leases[digest] = lease
        self.held[lease.is_background, lease.is_driven] += 1

    def end_lease(self, digest: bytes) -> Lease | None:
        """Note that it has a job no more; return the lease, `None` if it had none."""
        lease = self.leases.pop(digest, None)
        if lease is not None:
            self.held[lease.is_background, lease.is_driven] -= 1
        return lease

    @property
    def slot_steps_per_second(self) -> float:
        """Environment steps a second of one of its slots, while they worked; 0: not yet known."""
        return self.host_stats.steps_per_second

    @property
    def background_slots(self) -> int:
        """Slots that evaluations and collected rollouts take."""
        return self.held[True, False] + self.held[True, True]

    def add_verdict(self, verdict: Verdict) -> None:
        """Send a verdict with the next batch.

        R26: only so many wait to be confirmed, so that no worker fills the memory. It repeats a result that has none.
        """
        if self.unconfirmed_verdicts < MOST_VERDICTS:
            self.unconfirmed_verdicts += 1
            self.verdicts.append(verdict)

    def start_numbering(self, numbering: int) -> None:
        """Number its batches from 1 again, and forget what was to be sent: the worker repeats its results.

        R12: a new numbering separates what follows from all messages before a cut.
        """
        self.numbering, self.number, self.confirmed = numbering, 0, 0
        self.unconfirmed.clear()
        self.cancels, self.verdicts, self.unconfirmed_verdicts = [], [], 0

    def apply_heartbeat(self, beat: Heartbeat, now: float) -> list[SentBatch]:
        """Take what a heartbeat says of the worker; return the batches that it confirms for the first time.

        R11: a batch is kept until a heartbeat confirms it. R19: the first heartbeat confirms the worker
        with credit.
        """
        self.is_unconfirmed = False
        self.farewell = one_line(beat.reason)
        self.capacity, self.slots, self.confirmed = beat.capacity, beat.slots, beat.seen
        self.taken, self.side_by_side = beat.taken, beat.side_by_side
        self.batch_size = max(self.batch_size, math.ceil(beat.capacity / max(beat.slots, 1)))
        self.was_ready = self.was_ready or beat.capacity > 0
        self.load, self.steps_per_second, self.drawn_by = beat.load, beat.steps_per_second, beat.drawn_by
        if beat.running and beat.steps_per_second:
            self.host_stats.steps_per_second = beat.steps_per_second / len(beat.running)
        arrived = [self.unconfirmed.pop(number) for number in list(self.unconfirmed) if number <= beat.seen]
        self.unconfirmed_verdicts -= sum(len(sent.verdicts) for sent in arrived)
        if arrived and all(sent.times == 1 for sent in arrived):  # of a repeated batch, any sending may have arrived
            since = max(self.last_delivery, min(sent.first_sent_at for sent in arrived))
            self.host_stats.record_transfer(sum(sent.size for sent in arrived), now - since)
            self.host_stats.record_round_trip(now - max(sent.first_sent_at for sent in arrived))
        if arrived:
            self.last_delivery = now
        return arrived

    def update_leases(
        self, listed: Set[bytes | None], running: Mapping[bytes | None, int], finished: Set[bytes | None], now: float
    ) -> list[bytes]:
        """Note which jobs the last heartbeat listed and how far they are; return the digests whose leases end.

        R20: a lease ends when two heartbeats that confirm its batch do not list the job, so another worker gets it
        soon.
        """
        for digest, lease in self.leases.items():
            present = digest in listed or lease.batch > self.confirmed
            lease.absent_heartbeats = 0 if present else lease.absent_heartbeats + 1
            lease.steps, lease.steps_seen_at = running.get(digest), now
            lease.finished = digest in finished
        return [digest for digest, lease in self.leases.items() if lease.absent_heartbeats >= ABSENT_HEARTBEATS]

    def take_overdue_batches(self, now: float, after: float) -> Iterator[SentBatch]:
        """Batches to send again.

        R11: a batch is due after `after` seconds and the time that the link needs for all that is on the way, then
        after twice as long each time, so a slow link is not flooded.
        """
        ahead = 0
        for sent in self.unconfirmed.values():
            ahead += sent.size
            # The link is free since the last delivery.
            since = sent.sent_at if sent.sent_at == -math.inf else max(sent.sent_at, self.last_delivery)
            pause = after + self.host_stats.transfer_seconds(ahead)
            if now - since > pause * 2 ** min(sent.times - 1, MAX_BACKOFF):
                sent.sent_at, sent.times = now, sent.times + 1
                self.resent += 1
                yield sent

    def resend_before(self, batch: int) -> None:
        """Send unconfirmed batches with lower numbers again at once.

        R11: a later batch has arrived, so these were lost.
        """
        for number, sent in self.unconfirmed.items():
            if number < batch and sent.times == 1:
                sent.sent_at = -math.inf

    def resend_sent_before(self, moment: float) -> None:
        """Send unconfirmed batches again at once, except those sent after `moment`.

        R19: a hello in the name of a live worker only repeats what that worker may have missed.
        """
        for sent in self.unconfirmed.values():
            sent.sent_at = -math.inf if sent.sent_at <= moment else sent.sent_at

    def start_group(self, now: float) -> DispatchGroup:
        """Open the group of the jobs that the worker is given now."""
        return DispatchGroup(now, len(self.leases), only_scoring=not self.background_slots)

    def record_return(self, result: Result) -> None:
        """Note that one of its jobs is done."""
        group = self.trial_copies.pop(result.digest, None)
        if (lease := self.leases.get(result.digest)) is not None:
            group = lease.group
        if group is not None and result.fitness is not None:
            group.returned_count += 1
            self.returned.append(group)

    def record_superseded(self, lease: Lease, now: float) -> None:
        """Note that another worker's result came before the one of this lease."""
        if not lease.group.only_scoring or self.background_slots:
            return
        self.host_stats.record_superseded(
            lease.group.held_before + lease.group.returned_count + 1, now - lease.group.given_at, now
        )

    def record_turnarounds(self, now: float) -> None:
        """Learn from the results since the last call how soon this host returns jobs.

        R16: measured times, not a host's word, decide what it is given.
        """
        for each in dict.fromkeys(self.returned):
            if each.only_scoring and not self.background_slots:
                self.host_stats.record_turnaround(each.held_before + each.returned_count, now - each.given_at, now)
        self.returned.clear()
        self.trial_copies = {
            digest: each for digest, each in self.trial_copies.items() if now - each.given_at < TRIAL_SECONDS
        }

    def is_owed_reply(self, now: float, after: float) -> bool:
        """Whether it has spoken since the coordinator last did, and that was longer than `after` seconds ago.

        R22: a worker without any answer would say hello again.
        """
        return self.is_reachable and self.last_heard > self.last_sent and now - self.last_sent > after

    def shift_clock(self, gap: float) -> None:
        """Add `gap` seconds to all that is timed.

        R21: while this process was suspended it could hear nobody, so the gap is not the worker's silence.
        """
        self.last_heard += gap
        self.last_sent += gap
        for sent in self.unconfirmed.values():
            sent.sent_at += gap
        for group in {*(lease.group for lease in self.leases.values()), *self.trial_copies.values()}:
            group.given_at += gap


class DepartedWorkers(dict[str, Member]):
    """Workers that were lost, or said why they leave, by identity, the latest last: in the status, but no members."""

    def add(self, member: Member) -> None:
        """List a worker that is gone, unless it had drained and gave no reason."""
        if not member.is_unconfirmed and (member.capacity or member.farewell):
            self[member.identity] = member
            if len(self) > MAX_DEPARTED:  # R26: the list is bounded
                del self[next(iter(self))]

    def remove(self, identity: str) -> None:
        """Unlist a worker that is back; else one of the same host, of which this is another process."""
        others = (name for name in self if host_of(name) == host_of(identity))
        self.pop(identity if identity in self else next(others, ""), None)

    def expire(self, now: float) -> None:
        """Unlist the workers that were not heard for too long."""
        for name in [name for name, each in self.items() if now - each.last_heard > DEPARTED_TIMEOUT]:
            del self[name]
