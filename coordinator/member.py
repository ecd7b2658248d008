"""What the coordinator believes of one worker."""

from __future__ import annotations

from dataclasses import dataclass, field

from dreamfleet.common.messages import MAX_LEASES, Beat, Verdict
from dreamfleet.coordinator.packing import Content


@dataclass
class Lease:
    """A job in a worker's hands."""

    batch: int
    absent: int = 0  # beats in a row that have seen the batch and do not show the job
    steps: int | None = None  # environment steps that it has made, once a beat has shown it running
    ended: float | None = None  # when its result first came, of which the upload is still on its way


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
    known: bool = False  # by a beat: anybody can say hello
    number: int = 0
    seen: int = 0
    load: float = 0.0
    steps_per_second: float = 0.0
    pace: float = 0.0  # environment steps a second of one of its slots, while they worked; 0: not yet known
    drawn_by: str = "-"
    finished: int = 0
    leases: dict[bytes, Lease] = field(default_factory=dict)  # in the order in which they were given
    unseen: dict[int, Sent] = field(default_factory=dict)
    verdicts: list[Verdict] = field(default_factory=list)
    cancels: list[bytes] = field(default_factory=list)

    def observe(self, beat: Beat) -> None:
        """Take what a beat says of the worker itself."""
        self.known = True
        self.capacity, self.slots, self.seen = beat.capacity, beat.slots, beat.seen
        self.load, self.steps_per_second, self.drawn_by = beat.load, beat.steps_per_second, beat.drawn_by
        if beat.running and beat.steps_per_second:
            self.pace = beat.steps_per_second / len(beat.running)
        self.unseen = {number: sent for number, sent in self.unseen.items() if number > beat.seen}

    @property
    def present(self) -> bool:
        """Whether it may be given work."""
        return self.lost is None and not self.silent

    @property
    def credit(self) -> int:
        """How many more jobs it may be given."""
        return min(2 * self.capacity, MAX_LEASES) - len(self.leases) if self.present else 0
