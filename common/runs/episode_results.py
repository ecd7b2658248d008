"""What a controller did on unseen seeds: whole episodes, one a seed, and the figures that are told of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, median, pstdev, stdev

from dreamfleet.common.serialization.constraints import Count


@dataclass(frozen=True)
class EpisodeResult:
    """One whole episode as its judge saw it; `None` is what its world does not tell."""

    seed: Count
    score: float
    steps: Count  # environment steps
    finished: bool | None = None  # whether it came to its world's end of the course, such as a whole lap
    speed: float | None = None  # mean over its steps, in the world's own unit
    braking: float | None = None  # share of its steps with the brake on


@dataclass(frozen=True)
class EpisodeResults:
    """The drives of one controller, in the order of their seeds; at least one.

    >>> from dreamfleet import evaluate, find_controller
    >>> results = evaluate(find_controller("cartpole"), episodes=4, first_seed=1, jobs=1)
    >>> results.seeds
    (1, 2, 3, 4)
    >>> results.least <= results.mean <= results.most
    True
    """

    drives: tuple[EpisodeResult, ...]

    @classmethod
    def of(cls, drives: Iterable[EpisodeResult]) -> EpisodeResults:
        """From drives as they ended, in any order."""
        return cls(tuple(sorted(drives, key=lambda each: each.seed)))

    @property
    def seeds(self) -> tuple[int, ...]:
        """Of each drive."""
        return tuple(each.seed for each in self.drives)

    @property
    def scores(self) -> tuple[float, ...]:
        """Of each drive."""
        return tuple(each.score for each in self.drives)

    @property
    def mean(self) -> float:
        """Mean score."""
        return fmean(self.scores)

    @property
    def std(self) -> float:
        """Standard deviation between these tracks."""
        return pstdev(self.scores)

    @property
    def error(self) -> float | None:
        """Standard error of the mean, from the sample's deviation; `None`: one track has none."""
        return stdev(self.scores) / math.sqrt(len(self.scores)) if len(self.scores) > 1 else None

    @property
    def median(self) -> float:
        """Median score."""
        return median(self.scores)

    @property
    def least(self) -> float:
        """The worst score."""
        return min(self.scores)

    @property
    def most(self) -> float:
        """The best score."""
        return max(self.scores)

    @property
    def steps(self) -> int:
        """Environment steps of all drives."""
        return sum(each.steps for each in self.drives)

    @property
    def finished(self) -> int | None:
        """How many came to the end of the course; `None` where the world does not say."""
        told = [each.finished for each in self.drives if each.finished is not None]
        return sum(told) if told else None

    @property
    def speed(self) -> float | None:
        """Mean over all steps of all drives, where the world tells it."""
        return _mean_over_steps([(each.speed, each.steps) for each in self.drives])

    @property
    def braking(self) -> float | None:
        """Share of all steps with the brake on, where the world tells it."""
        return _mean_over_steps([(each.braking, each.steps) for each in self.drives])

    def above(self, score: float) -> float:
        """Share of the drives that scored more than this."""
        return sum(each > score for each in self.scores) / len(self.scores)


def _mean_over_steps(told: Sequence[tuple[float | None, int]]) -> float | None:
    """The mean of a figure of each drive, a drive counting as often as it has steps."""
    known = [(value, steps) for value, steps in told if value is not None]
    steps = sum(steps for _, steps in known)
    return sum(value * steps for value, steps in known) / steps if steps else None
