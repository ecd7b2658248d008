"""What experience with a host says: how soon it brings jobs back, what its link carries, how long it lives. Pure.

It outlives a worker's life: whoever joins again, or is started again under the same name, is known already.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from dreamfleet.common.protocol.messages import Kind

UNKNOWN_LINK = 32_000.0  # bytes a second that a link is thought to carry before it has shown what it does
RATE_DECAY = 0.95  # of the best rate that a link has shown remains with each new one
RISING, FALLING = 0.5, 0.2  # weight of a slower and of a faster turnaround
GROWTH, SHRINKING = 0.9, 0.25  # powers of their number that more jobs than ever, or fewer, should take
TURNAROUND_MEMORY = 60.0  # seconds that a turnaround is remembered where there is a newer one
DEVIATIONS = 2.0  # above the mean that are still expected, as TCP's retransmission timer reckons (RFC 6298: four)
LIFETIMES = 8.0  # a host that dies is given what it should bring back in this part of a life
DEATHS = 2  # with jobs in its hands, after which a host counts as one that dies


@dataclass
class Turnaround:
    """Seconds until so many jobs are back: mean and mean deviation."""

    mean: float
    at: float  # when it was last seen
    deviation: float = 0.0

    def learn(self, seconds: float) -> None:
        """It took so long this time."""
        error = seconds - self.mean
        self.deviation += FALLING * (abs(error) - self.deviation)
        self.mean += (RISING if error > 0 else FALLING) * error

    @property
    def seconds(self) -> float:
        """That nearly all should take."""
        return self.mean + DEVIATIONS * self.deviation


@dataclass
class HostStats:
    """One host's; `turnarounds` by the power of two that the number of jobs in its hands came up to."""

    turnarounds: dict[int, Turnaround] = field(default_factory=dict)
    bandwidth: float = UNKNOWN_LINK  # bytes a second towards it
    last_return: float = -math.inf  # when a job last came back
    deaths: int = 0  # since it last proved to live
    mean_lifetime: float = math.inf  # seconds between them
    steps_per_second: float = 0.0  # environment steps a second of one of its slots
    job_seconds: float | None = None  # seconds that a candidate's job takes one of its slots
    evaluation_seconds: float | None = None  # the same of an evaluation's
    round_trip: float | None = None  # seconds until a batch was known to have arrived, at best

    def copy(self) -> HostStats:
        """The same for another life of it."""
        return replace(self, turnarounds={size: replace(each) for size, each in self.turnarounds.items()})

    @property
    def has_history(self) -> bool:
        """Whether it ever brought a job back."""
        return bool(self.turnarounds)

    def learn(self, jobs: int, seconds: float, now: float) -> None:
        """So many jobs in its hands were back after so long."""
        self.last_return = now
        size = _size_class(jobs)
        here = self.turnarounds.setdefault(size, Turnaround(seconds, now))
        here.learn(seconds)
        here.at = now
        self.turnarounds = {
            other: each for other, each in self.turnarounds.items() if now - each.at < TURNAROUND_MEMORY
        }
        for larger, old in self.turnarounds.items():
            most = here.seconds * 2 ** (larger - size)
            if larger > size and old.seconds > most:  # that was another time
                self.turnarounds[larger] = Turnaround(most, now)

    def record_superseded(self, jobs: int, seconds: float, now: float) -> None:
        """A job was not back after so long, when another host's result made it needless."""
        if self.has_history and seconds > self.expected_seconds(jobs):
            self.turnarounds.setdefault(_size_class(jobs), Turnaround(seconds, now)).learn(seconds)

    def expected_seconds(self, jobs: int) -> float:
        """Seconds until it has brought so many back, if they are all that it has.

        More jobs than it ever had are expected to take nearly as much longer, fewer somewhat less; a host of which
        nothing is known never brings any back.
        """
        size = _size_class(jobs)
        if (exactly := self.turnarounds.get(size)) is not None:
            return exactly.seconds
        smaller = max((each for each in self.turnarounds if each < size), default=None)
        larger = min((each for each in self.turnarounds if each > size), default=None)
        bounds = [math.inf]
        if smaller is not None:
            bounds.append(self.turnarounds[smaller].seconds * 2 ** (GROWTH * (size - smaller)))
        if larger is not None:
            bounds.append(
                self.turnarounds[larger].seconds * (1.0 if smaller is not None else 2 ** ((size - larger) / 4))
            )
        return min(bounds)

    @property
    def rate(self) -> float:
        """Jobs a second that it has brought back at best."""
        return max((2**size / max(each.mean, 1e-9) for size, each in self.turnarounds.items()), default=0.0)

    def record_death(self, age: float) -> None:
        """It was lost at this age, with jobs in its hands."""
        self.deaths += 1
        self.mean_lifetime = (
            age if self.mean_lifetime == math.inf else self.mean_lifetime + RISING * (age - self.mean_lifetime)
        )

    def is_likely_lost(self, jobs: int, age: float) -> bool:
        """Whether it may well be lost before it brings so many back."""
        return self.deaths >= DEATHS and self.expected_seconds(jobs) * LIFETIMES > max(self.mean_lifetime, age)

    def record_duration(self, kind: Kind, seconds: float) -> None:
        """A job of this kind took a slot so long."""
        if kind == "score":
            self.job_seconds = _smoothed(self.job_seconds, seconds)
        elif kind == "evaluate":
            self.evaluation_seconds = _smoothed(self.evaluation_seconds, seconds)

    def record_round_trip(self, seconds: float) -> None:
        """A batch was known to have arrived so long after it was sent."""
        self.round_trip = seconds if self.round_trip is None else min(seconds, self.round_trip / RATE_DECAY)

    def record_transfer(self, size: int, seconds: float) -> None:
        """So many bytes had arrived after so long; a beat says so, which makes it a lower bound."""
        self.bandwidth = max(size / max(seconds, 1e-3), RATE_DECAY * self.bandwidth)

    def transfer_seconds(self, size: int) -> float:
        """Seconds that its link takes for so many bytes."""
        return size / self.bandwidth


def _size_class(jobs: int) -> int:
    return max(jobs - 1, 0).bit_length()


def _smoothed(before: float | None, seconds: float) -> float:
    return seconds if before is None else before + FALLING * (seconds - before)
