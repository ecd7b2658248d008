"""What the coordinator believes of one worker."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from dreamfleet.common.protocol.messages import MAX_LEASES, Heartbeat, Result, Verdict
from dreamfleet.coordinator.dispatch.host_stats import HostStats
from dreamfleet.coordinator.dispatch.packing import BatchContent

TRIAL_SECONDS = 60.0  # after which a copy that shows nothing is given up


@dataclass(eq=False)
class DispatchGroup:
    """Jobs that a worker was given at one moment; `returned_count` of them have come back."""

    given_at: float
    held_before: int
    returned_count: int = 0
    only_scoring: bool = True  # whether it held nothing but candidates' jobs, so that its time says how soon it is


@dataclass
class Lease:
    """A job in a worker's hands."""

    batch: int
    group: DispatchGroup
    is_background: bool = False
    absent_beats: int = 0  # beats in a row that have seen the batch and do not show the job
    steps: int | None = None  # environment steps that it has made, once a beat has shown it running
    steps_seen_at: float = 0.0  # when it did
    upload_pending_since: float | None = None  # when its result first came, of which the upload is still on its way


@dataclass
class SentBatch:
    """A batch that its worker has not confirmed."""

    content: BatchContent
    sent_at: float
    first_sent_at: float  # when it was sent for the first time
    times: int = 1


@dataclass
class Member:
    """What the coordinator believes of one worker."""

    identity: str
    slots: int
    fingerprint: str
    numbering: int  # of its batches
    last_heard: float
    joined_at: float = 0.0
    host_stats: HostStats = field(default_factory=HostStats)
    capacity: int = 0  # unknown, and so without credit, before its first beat
    lost: float | None = None
    silent: bool = False
    has_beaten: bool = False  # by a beat: anybody can say hello
    number: int = 0
    seen: int = 0
    load: float = 0.0
    steps_per_second: float = 0.0
    drawn_by: str = "-"
    host_class: str = ""  # not known yet
    finished: int = 0
    resent: int = 0  # batches that were sent again
    leases: dict[bytes, Lease] = field(default_factory=dict)  # in the order in which they were given
    trial_copies: dict[bytes, DispatchGroup] = field(
        default_factory=dict
    )  # copies that show how soon it is, wanted or not
    returned: list[DispatchGroup] = field(default_factory=list)  # of which something came back since the last dispatch
    last_delivery: float = 0.0  # when it was last known to have seen everything, or something more
    last_sent: float = 0.0  # when anything was last sent
    unseen: dict[int, SentBatch] = field(default_factory=dict)
    verdicts: list[Verdict] = field(default_factory=list)
    cancels: list[bytes] = field(default_factory=list)

    def begin_numbering(self, numbering: int) -> None:
        """What it is given is counted from 1 again; it is owed no word, for it will say again what it did."""
        self.numbering, self.number, self.seen = numbering, 0, 0
        self.unseen.clear()
        self.cancels, self.verdicts = [], []

    def apply_beat(self, beat: Heartbeat, now: float) -> list[SentBatch]:
        """Take what a beat says of the worker itself; the batches that it has seen since the last one."""
        self.has_beaten = True
        self.capacity, self.slots, self.seen = beat.capacity, beat.slots, beat.seen
        self.load, self.steps_per_second, self.drawn_by = beat.load, beat.steps_per_second, beat.drawn_by
        if beat.running and beat.steps_per_second:
            self.host_stats.steps_per_second = beat.steps_per_second / len(beat.running)
        arrived = [self.unseen.pop(number) for number in list(self.unseen) if number <= beat.seen]
        if arrived and all(sent.times == 1 for sent in arrived):  # else nobody knows which of them arrived
            since = max(self.last_delivery, min(sent.first_sent_at for sent in arrived))
            self.host_stats.record_transfer(sum(sent.content.size for sent in arrived), now - since)
            self.host_stats.record_round_trip(now - max(sent.first_sent_at for sent in arrived))
        if arrived:
            self.last_delivery = now
        return arrived

    def overdue(self, now: float, patience: float) -> list[int]:
        """Batches to send again: not seen for `patience`, and what the link takes for all that is on the way."""
        late, ahead = [], 0
        for number, sent in self.unseen.items():
            ahead += sent.content.size
            since = (
                sent.sent_at if sent.sent_at == -math.inf else max(sent.sent_at, self.last_delivery)
            )  # the link is free since then
            if now - since > (patience + self.host_stats.transfer_seconds(ahead)) * 2 ** min(sent.times - 1, 4):
                late.append(number)
        return late

    def new_group(self, now: float) -> DispatchGroup:
        """What it is given now."""
        return DispatchGroup(now, len(self.leases), only_scoring=not self.background_slots)

    def record_return(self, result: Result) -> None:
        """One of its jobs is done."""
        group = self.trial_copies.pop(result.digest, None)
        if (lease := self.leases.get(result.digest)) is not None:
            group = lease.group
        if group is not None and result.fitness is not None:
            group.returned_count += 1
            self.returned.append(group)

    def record_superseded(self, lease: Lease, now: float) -> None:
        """A job of its is not needed any more."""
        if not lease.group.only_scoring or self.background_slots:
            return
        self.host_stats.record_superseded(
            lease.group.held_before + lease.group.returned_count + 1, now - lease.group.given_at, now
        )

    def mark_lost_before(self, batch: int) -> None:
        """What it shows came with this batch: those before it that it has not seen were lost."""
        for number, sent in self.unseen.items():
            if number < batch and sent.times == 1:
                sent.sent_at = -math.inf

    def mark_for_resend(self, since: float) -> None:
        """It may have been out of reach: what it has not seen is sent again at once, unless it was sent since then."""
        for sent in self.unseen.values():
            sent.sent_at = -math.inf if sent.sent_at <= since else sent.sent_at

    def is_owed_reply(self, now: float, patience: float) -> bool:
        """Whether it has spoken since it was last spoken to, so long ago."""
        return self.present and self.last_heard > self.last_sent and now - self.last_sent > patience

    def shift_clock(self, gap: float) -> None:
        """The clock stood still."""
        for group in {*(lease.group for lease in self.leases.values()), *self.trial_copies.values()}:
            group.given_at += gap
        self.last_sent += gap

    def learn(self, now: float) -> None:
        """How soon what has come back since the last time was back."""
        for each in dict.fromkeys(self.returned):
            if each.only_scoring and not self.background_slots:
                self.host_stats.learn(each.held_before + each.returned_count, now - each.given_at, now)
        self.returned.clear()
        self.trial_copies = {
            digest: each for digest, each in self.trial_copies.items() if now - each.given_at < TRIAL_SECONDS
        }

    @property
    def slot_steps_per_second(self) -> float:
        """Environment steps a second of one of its slots, while they worked; 0: not yet known."""
        return self.host_stats.steps_per_second

    @property
    def background_slots(self) -> int:
        """Slots that evaluations and collected rollouts take."""
        return sum(lease.is_background for lease in self.leases.values())

    @property
    def present(self) -> bool:
        """Whether it may be given work."""
        return self.lost is None and not self.silent

    @property
    def credit(self) -> int:
        """How many more jobs it may be given."""
        return min(2 * self.capacity, MAX_LEASES) - len(self.leases) if self.present else 0
