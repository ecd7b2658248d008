"""What the coordinator believes of one worker."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from dreamfleet.common.messages import MAX_LEASES, Beat, Result, Verdict
from dreamfleet.coordinator.packing import Content
from dreamfleet.coordinator.record import HostRecord

TRIAL_SECONDS = 60.0  # after which a copy that shows nothing is given up


@dataclass(eq=False)
class Handful:
    """Jobs that a worker was given at one moment, beside so many that it had; `back` of them have come back."""

    given: float
    before: int
    back: int = 0
    alone: bool = True  # whether it held nothing but candidates' jobs, so that its time says how soon it is


@dataclass
class Lease:
    """A job in a worker's hands."""

    batch: int
    handful: Handful
    in_slack: bool = False
    absent: int = 0  # beats in a row that have seen the batch and do not show the job
    steps: int | None = None  # environment steps that it has made, once a beat has shown it running
    told: float = 0.0  # when it did
    ended: float | None = None  # when its result first came, of which the upload is still on its way


@dataclass
class Sent:
    """A batch that its worker has not confirmed."""

    content: Content
    at: float
    first: float  # when it was sent for the first time
    times: int = 1


@dataclass
class Member:
    """What the coordinator believes of one worker."""

    identity: str
    slots: int
    fingerprint: str
    numbering: int  # of its batches
    heard: float
    born: float = 0.0
    record: HostRecord = field(default_factory=HostRecord)
    capacity: int = 0  # unknown, and so without credit, before its first beat
    lost: float | None = None
    silent: bool = False
    known: bool = False  # by a beat: anybody can say hello
    number: int = 0
    seen: int = 0
    load: float = 0.0
    steps_per_second: float = 0.0
    drawn_by: str = "-"
    host_class: str = ""  # not known yet
    finished: int = 0
    resent: int = 0  # batches that were sent again
    leases: dict[bytes, Lease] = field(default_factory=dict)  # in the order in which they were given
    trials: dict[bytes, Handful] = field(default_factory=dict)  # copies that show how soon it is, wanted or not
    returned: list[Handful] = field(default_factory=list)  # of which something came back since the last dispatch
    delivered: float = 0.0  # when it was last known to have seen everything, or something more
    spoken: float = 0.0  # when anything was last sent
    unseen: dict[int, Sent] = field(default_factory=dict)
    verdicts: list[Verdict] = field(default_factory=list)
    cancels: list[bytes] = field(default_factory=list)

    def begin_numbering(self, numbering: int) -> None:
        """What it is given is counted from 1 again; it is owed no word, for it will say again what it did."""
        self.numbering, self.number, self.seen = numbering, 0, 0
        self.unseen.clear()
        self.cancels, self.verdicts = [], []

    def observe(self, beat: Beat, now: float) -> list[Sent]:
        """Take what a beat says of the worker itself; the batches that it has seen since the last one."""
        self.known = True
        self.capacity, self.slots, self.seen = beat.capacity, beat.slots, beat.seen
        self.load, self.steps_per_second, self.drawn_by = beat.load, beat.steps_per_second, beat.drawn_by
        if beat.running and beat.steps_per_second:
            self.record.steps = beat.steps_per_second / len(beat.running)
        arrived = [self.unseen.pop(number) for number in list(self.unseen) if number <= beat.seen]
        if arrived and all(sent.times == 1 for sent in arrived):  # else nobody knows which of them arrived
            since = max(self.delivered, min(sent.first for sent in arrived))
            self.record.delivered(sum(sent.content.size for sent in arrived), now - since)
            self.record.confirmed(now - max(sent.first for sent in arrived))
        if arrived:
            self.delivered = now
        return arrived

    def overdue(self, now: float, patience: float) -> list[int]:
        """Batches to send again: not seen for `patience`, and what the link takes for all that is on the way."""
        late, ahead = [], 0
        for number, sent in self.unseen.items():
            ahead += sent.content.size
            since = sent.at if sent.at == -math.inf else max(sent.at, self.delivered)  # the link is free since then
            if now - since > (patience + self.record.delivery(ahead)) * 2 ** min(sent.times - 1, 4):
                late.append(number)
        return late

    def give(self, now: float) -> Handful:
        """What it is given now."""
        return Handful(now, len(self.leases), alone=not self.occupied)

    def take_back(self, result: Result) -> None:
        """One of its jobs is done."""
        handful = self.trials.pop(result.digest, None)
        if (lease := self.leases.get(result.digest)) is not None:
            handful = lease.handful
        if handful is not None and result.fitness is not None:
            handful.back += 1
            self.returned.append(handful)

    def overtaken(self, lease: Lease, now: float) -> None:
        """A job of its is not needed any more."""
        if not lease.handful.alone or self.occupied:
            return
        self.record.overtaken(lease.handful.before + lease.handful.back + 1, now - lease.handful.given, now)

    def lose_before(self, batch: int) -> None:
        """What it shows came with this batch: those before it that it has not seen were lost."""
        for number, sent in self.unseen.items():
            if number < batch and sent.times == 1:
                sent.at = -math.inf

    def send_again(self, since: float) -> None:
        """It may have been out of reach: what it has not seen is sent again at once, unless it was sent since then."""
        for sent in self.unseen.values():
            sent.at = -math.inf if sent.at <= since else sent.at

    def awaits_word(self, now: float, patience: float) -> bool:
        """Whether it has spoken since it was last spoken to, so long ago."""
        return self.present and self.heard > self.spoken and now - self.spoken > patience

    def put_off(self, gap: float) -> None:
        """The clock stood still."""
        for handful in {*(lease.handful for lease in self.leases.values()), *self.trials.values()}:
            handful.given += gap
        self.spoken += gap

    def learn(self, now: float) -> None:
        """How soon what has come back since the last time was back."""
        for each in dict.fromkeys(self.returned):
            if each.alone and not self.occupied:
                self.record.learn(each.before + each.back, now - each.given, now)
        self.returned.clear()
        self.trials = {digest: each for digest, each in self.trials.items() if now - each.given < TRIAL_SECONDS}

    @property
    def pace(self) -> float:
        """Environment steps a second of one of its slots, while they worked; 0: not yet known."""
        return self.record.steps

    @property
    def occupied(self) -> int:
        """Slots that evaluations and collected rollouts take."""
        return sum(lease.in_slack for lease in self.leases.values())

    @property
    def present(self) -> bool:
        """Whether it may be given work."""
        return self.lost is None and not self.silent

    @property
    def credit(self) -> int:
        """How many more jobs it may be given."""
        return min(2 * self.capacity, MAX_LEASES) - len(self.leases) if self.present else 0
