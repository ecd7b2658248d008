"""What experience with a host says: how soon it brings jobs back, what its link carries, how long it lives. Pure.

It outlives a worker's life: whoever joins again, or is started again under the same name, is known already.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from dreamfleet.common.messages import Kind

UNKNOWN_LINK = 32_000.0  # bytes a second that a link is thought to carry before it has shown what it does
FORGOTTEN = 0.95  # of the best rate that a link has shown remains with each new one
RISING, FALLING = 0.5, 0.2  # weight of a slower and of a faster turnaround
GROWTH, SHRINKING = 0.9, 0.25  # powers of their number that more jobs than ever, or fewer, should take
MEMORY = 60.0  # seconds that a turnaround is remembered where there is a newer one
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
class HostRecord:
    """One host's; `turnarounds` by the power of two that the number of jobs in its hands came up to."""

    turnarounds: dict[int, Turnaround] = field(default_factory=dict)
    bandwidth: float = UNKNOWN_LINK  # bytes a second towards it
    learned: float = -math.inf  # when a job last came back
    deaths: int = 0  # since it last proved to live
    life: float = math.inf  # seconds between them
    steps: float = 0.0  # environment steps a second of one of its slots
    job: float | None = None  # seconds that a candidate's job takes one of its slots
    evaluation: float | None = None  # the same of an evaluation's
    trip: float | None = None  # seconds until a batch was known to have arrived, at best

    def inherit(self) -> HostRecord:
        """The same for another life of it."""
        return replace(self, turnarounds={size: replace(each) for size, each in self.turnarounds.items()})

    @property
    def known(self) -> bool:
        """Whether it ever brought a job back."""
        return bool(self.turnarounds)

    def learn(self, jobs: int, seconds: float, now: float) -> None:
        """So many jobs in its hands were back after so long."""
        self.learned = now
        size = _size(jobs)
        here = self.turnarounds.setdefault(size, Turnaround(seconds, now))
        here.learn(seconds)
        here.at = now
        self.turnarounds = {other: each for other, each in self.turnarounds.items() if now - each.at < MEMORY}
        for larger, old in self.turnarounds.items():
            most = here.seconds * 2 ** (larger - size)
            if larger > size and old.seconds > most:  # that was another time
                self.turnarounds[larger] = Turnaround(most, now)

    def overtaken(self, jobs: int, seconds: float, now: float) -> None:
        """A job was not back after so long, when another host's result made it needless."""
        if self.known and seconds > self.expected(jobs):
            self.turnarounds.setdefault(_size(jobs), Turnaround(seconds, now)).learn(seconds)

    def expected(self, jobs: int) -> float:
        """Seconds until it has brought so many back, if they are all that it has.

        More jobs than it ever had are expected to take nearly as much longer, fewer somewhat less; a host of which
        nothing is known never brings any back.
        """
        size = _size(jobs)
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

    def die(self, age: float) -> None:
        """It was lost at this age, with jobs in its hands."""
        self.deaths += 1
        self.life = age if self.life == math.inf else self.life + RISING * (age - self.life)

    def risky(self, jobs: int, age: float) -> bool:
        """Whether it may well be lost before it brings so many back."""
        return self.deaths >= DEATHS and self.expected(jobs) * LIFETIMES > max(self.life, age)

    def took(self, kind: Kind, seconds: float) -> None:
        """A job of this kind took a slot so long."""
        if kind == "score":
            self.job = _smoothed(self.job, seconds)
        elif kind == "evaluate":
            self.evaluation = _smoothed(self.evaluation, seconds)

    def confirmed(self, seconds: float) -> None:
        """A batch was known to have arrived so long after it was sent."""
        self.trip = seconds if self.trip is None else min(seconds, self.trip / FORGOTTEN)

    def delivered(self, size: int, seconds: float) -> None:
        """So many bytes had arrived after so long; a beat says so, which makes it a lower bound."""
        self.bandwidth = max(size / max(seconds, 1e-3), FORGOTTEN * self.bandwidth)

    def delivery(self, size: int) -> float:
        """Seconds that its link takes for so many bytes."""
        return size / self.bandwidth


def _size(jobs: int) -> int:
    return max(jobs - 1, 0).bit_length()


def _smoothed(before: float | None, seconds: float) -> float:
    return seconds if before is None else before + FALLING * (seconds - before)
