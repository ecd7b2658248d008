"""Whether one controller drives better than another, on the seeds that both drove."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import fmean, stdev

from dreamfleet.common.errors import UsageError
from dreamfleet.common.evaluated import Evaluated

CLEAR = 2  # standard errors: a smaller difference is none


@dataclass(frozen=True)
class Difference:
    """The mean of one controller's score less another's, seed by seed: what tracks have in common falls out."""

    seeds: int
    mean: float
    error: float  # standard error of the mean

    @classmethod
    def between(cls, one: Evaluated, other: Evaluated) -> Difference:
        """Of the `other` less the `one`; `UsageError` where they share fewer than two seeds."""
        return cls.of(_by_seed(one), _by_seed(other))

    @classmethod
    def of(cls, one: Mapping[int, float], other: Mapping[int, float]) -> Difference:
        """As `between`, of scores by seed."""
        shared = sorted(one.keys() & other.keys())
        if len(shared) < 2:
            raise UsageError(
                f"{len(shared)} seeds are in both, and a difference needs 2: evaluate both with equal --first-seed and "
                "--episodes"
            )
        differences = [other[seed] - one[seed] for seed in shared]
        return cls(len(shared), fmean(differences), stdev(differences) / math.sqrt(len(shared)))

    @property
    def clear(self) -> bool:
        """Whether it is more than two standard errors."""
        return abs(self.mean) > CLEAR * self.error

    @property
    def told(self) -> str:
        """In words."""
        if self.mean == self.error == 0:
            return f"the same scores, to the bit, on {self.seeds} equal seeds"
        found = f"{self.mean:+.1f} ± {self.error:.1f} (standard error) on {self.seeds} equal seeds"
        if self.clear:
            return f"{found}: {'better' if self.mean > 0 else 'worse'}"
        return f"{found}: none, for a difference under two standard errors is none"


def _by_seed(evaluated: Evaluated) -> dict[int, float]:
    return dict(zip(evaluated.seeds, evaluated.scores, strict=True))
