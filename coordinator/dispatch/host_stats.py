"""What experience with a host says: how soon it returns jobs, how fast its link is, how long it stays up. Pure.

R16: the coordinator measures a host before it relies on it. The record outlives a worker: the next worker of the same
host starts with it. Pages: status.md, metrics.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.protocol.messages import Kind

UNKNOWN_LINK = 32_000.0  # bytes a second: assumed of a link before the first measurement
RATE_DECAY = 0.95  # factor of the best measured rate at each new measurement
RISING, FALLING = 0.5, 0.2  # weights of a slower and of a faster new value in a moving mean
GROWTH, SHRINKING = 0.9, 0.25  # exponents: expected time of more, and of fewer, jobs than ever measured
DURATIONS = 64  # jobs whose mean says how long one takes: episodes of one task may differ tenfold
SHORTEST = 1e-9  # seconds that a turnaround counts at least
TURNAROUND_MEMORY = 60.0  # seconds that a turnaround is remembered after a newer one
DEVIATIONS = 2.0  # above the mean that are still expected, like TCP's retransmission timer (RFC 6298: four)
LIFETIMES = 8.0  # an unreliable host is given only jobs that take less than this part of its lifetime
UNRELIABLE_LOSSES = 2  # losses with jobs in hand after which a host counts as unreliable
MAX_HOSTS = 4096  # hosts that are remembered, the latest that joined


@dataclass
class Turnaround:
    """Seconds until a number of jobs is back: moving mean and mean deviation."""

    mean: float
    at: float  # when it was last measured
    deviation: float = 0.0

    def update(self, seconds: float) -> None:
        """Add a measurement."""
        error = seconds - self.mean
        self.deviation += FALLING * (abs(error) - self.deviation)
        self.mean += (RISING if error > 0 else FALLING) * error

    @property
    def seconds(self) -> float:
        """An upper bound that nearly all jobs keep."""
        return self.mean + DEVIATIONS * self.deviation


@dataclass(frozen=True)
class JobDuration:
    """Mean seconds that a job takes a slot, over about the last `DURATIONS` jobs."""

    mean: float | None = None
    jobs: int = 0

    def with_job(self, seconds: float) -> JobDuration:
        """The mean with one more job."""
        jobs, before = min(self.jobs + 1, DURATIONS), seconds if self.mean is None else self.mean
        return JobDuration(before + (seconds - before) / jobs, jobs)


@dataclass
class HostStats:
    """One host's record; `turnarounds` by size class, the logarithm to base 2 of the number of jobs, rounded up."""

    turnarounds: dict[int, Turnaround] = field(default_factory=dict)
    bandwidth: float = UNKNOWN_LINK  # bytes a second towards it
    last_return: float = -math.inf  # when it last returned a job
    losses: int = 0  # how often it was lost with jobs in hand
    mean_lifetime: float = math.inf  # seconds, of the workers that were lost
    steps_per_second: float = 0.0  # environment steps a second of one of its slots
    scoring: JobDuration = JobDuration()  # of a candidate's job
    evaluation: JobDuration = JobDuration()
    round_trip: float | None = None  # seconds until a heartbeat confirmed a batch, at best

    def copy(self) -> HostStats:
        """An independent copy, for another worker of the host."""
        return replace(self, turnarounds={size: replace(each) for size, each in self.turnarounds.items()})

    @property
    def has_history(self) -> bool:
        """Whether it ever returned a job."""
        return bool(self.turnarounds)

    def record_turnaround(self, jobs: int, seconds: float, now: float) -> None:
        """Note that the host returned `jobs` jobs within `seconds`."""
        self.last_return = now
        size = _size_class(jobs)
        here = self.turnarounds.setdefault(size, Turnaround(seconds, now))
        here.update(seconds)
        here.at = now
        self.turnarounds = {
            other: each for other, each in self.turnarounds.items() if now - each.at < TURNAROUND_MEMORY
        }
        for larger, old in self.turnarounds.items():
            bound = here.seconds * 2 ** (larger - size)
            if larger > size and old.seconds > bound:  # the host was slower then
                self.turnarounds[larger] = Turnaround(bound, now)

    def record_superseded(self, jobs: int, seconds: float, now: float) -> None:
        """Note that a job was not back after `seconds`, when another host's result came."""
        if self.has_history and seconds > self.expected_seconds(jobs):
            self.turnarounds.setdefault(_size_class(jobs), Turnaround(seconds, now)).update(seconds)

    def expected_seconds(self, jobs: int) -> float:
        """Seconds until the host has returned `jobs` jobs, if it holds no others; infinite without a record.

        More jobs than ever measured take nearly proportionally longer, fewer than ever measured somewhat less. Between
        two measured numbers of jobs, the time grows by equal factors.
        """
        size = _size_class(jobs)
        if (exactly := self.turnarounds.get(size)) is not None:
            return exactly.seconds
        smaller = max((each for each in self.turnarounds if each < size), default=None)
        larger = min((each for each in self.turnarounds if each > size), default=None)
        after = math.inf if larger is None else self.turnarounds[larger].seconds
        if smaller is None:
            return after if larger is None else after * 2 ** (SHRINKING * (size - larger))
        before, growth = self.turnarounds[smaller].seconds, GROWTH
        if larger is not None:
            ratio = max(after / max(before, SHORTEST), 1.0)
            growth = min(GROWTH, math.log2(ratio) / (larger - smaller))
        return min(before * 2 ** (growth * (size - smaller)), after)

    @property
    def rate(self) -> float:
        """The highest measured rate, in jobs a second."""
        return max((2**size / max(each.mean, SHORTEST) for size, each in self.turnarounds.items()), default=0.0)

    def record_loss(self, age: float) -> None:
        """Note that a worker of this host was lost with jobs in hand, `age` seconds after it joined."""
        self.losses += 1
        self.mean_lifetime = (
            age if self.mean_lifetime == math.inf else self.mean_lifetime + RISING * (age - self.mean_lifetime)
        )

    def is_likely_lost(self, jobs: int, age: float) -> bool:
        """Whether a worker of this age may well be lost before it has returned `jobs` jobs."""
        return self.losses >= UNRELIABLE_LOSSES and self.expected_seconds(jobs) * LIFETIMES > max(
            self.mean_lifetime, age
        )

    def record_duration(self, kind: Kind, seconds: float) -> None:
        """Note how long a job of this kind took a slot."""
        if kind == "score":
            self.scoring = self.scoring.with_job(seconds)
        elif kind == "evaluate":
            self.evaluation = self.evaluation.with_job(seconds)

    def record_round_trip(self, seconds: float) -> None:
        """Note the time from sending a batch to its confirmation."""
        self.round_trip = seconds if self.round_trip is None else min(seconds, self.round_trip / RATE_DECAY)

    def record_transfer(self, size: int, seconds: float) -> None:
        """Note that `size` bytes arrived within `seconds`: a lower bound, as heartbeats confirm late."""
        self.bandwidth = max(size / max(seconds, 1e-3), RATE_DECAY * self.bandwidth)

    def transfer_seconds(self, size: int) -> float:
        """Seconds that the link takes for `size` bytes."""
        return size / self.bandwidth


class HostRecords:
    """The records of the hosts that joined last, by host name."""

    def __init__(self) -> None:
        self._records: dict[str, HostStats] = {}  # the latest that joined last

    def join(self, identity: str, current: HostStats | None) -> HostStats:
        """The record for a worker that joins: its `current` one, else a copy of its host's, else an empty one."""
        name = host_of(identity)
        last = self._records.pop(name, None)
        host_stats = current or (last.copy() if last else HostStats())
        self._records[name] = host_stats
        while len(self._records) > MAX_HOSTS:  # R26: unknown senders can invent names without end
            del self._records[next(iter(self._records))]
        return host_stats

    def get(self, identity: str) -> HostStats | None:
        """The record of a worker's host."""
        return self._records.get(host_of(identity))


def _size_class(jobs: int) -> int:
    return max(jobs - 1, 0).bit_length()
