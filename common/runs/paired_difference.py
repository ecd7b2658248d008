"""Comparison of two controllers on the seeds that both were evaluated on. Pages: export.md, protocol.md, results.md."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist, fmean

from dreamfleet.common.errors import UsageError
from dreamfleet.common.runs.episode_results import EpisodeResults
from dreamfleet.common.runs.standard_error import format_with_error, standard_error

SIGNIFICANT_ERRORS = 2  # critical value in standard errors, for many seeds
MANY_SEEDS = 30


@dataclass(frozen=True)
class PairedDifference:
    """The mean difference of two controllers' scores, paired by seed: the variance between tracks cancels."""

    seeds: int
    mean: float
    error: float  # standard error of the mean

    @classmethod
    def between(cls, one: EpisodeResults, other: EpisodeResults) -> PairedDifference:
        """`other` minus `one`; `UsageError` if they share fewer than two seeds."""
        return cls.of(_scores_by_seed(one), _scores_by_seed(other))

    @classmethod
    def of(cls, one: Mapping[int, float], other: Mapping[int, float]) -> PairedDifference:
        """Like `between`, from scores by seed."""
        shared = sorted(one.keys() & other.keys())
        if len(shared) < 2:
            raise UsageError(
                f"a difference needs 2 seeds that are in both, not {len(shared)}: evaluate both with equal "
                "--first-seed and --episodes"
            )
        differences = [other[seed] - one[seed] for seed in shared]
        error = standard_error(differences)
        assert error is not None
        return cls(len(shared), fmean(differences), error)

    @property
    def critical_value(self) -> float:
        """Standard errors that a significant difference must exceed: two for many seeds, more for few.

        Student's t with `seeds - 1` degrees of freedom at the probability of two standard deviations of a normal
        distribution: exact for one and two, else by its expansion in 1 / (seeds - 1) (Abramowitz & Stegun 26.7.5).
        """
        if self.seeds >= MANY_SEEDS:
            return SIGNIFICANT_ERRORS
        z, freedom = float(SIGNIFICANT_ERRORS), self.seeds - 1
        within = 2 * NormalDist().cdf(z) - 1
        if freedom == 1:
            return math.tan(math.pi / 2 * within)
        if freedom == 2:
            return within * math.sqrt(2 / (1 - within**2))
        first, second = (z**3 + z) / 4, (5 * z**5 + 16 * z**3 + 3 * z) / 96
        third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
        return z + first / freedom + second / freedom**2 + third / freedom**3

    @property
    def threshold_text(self) -> str:
        """The critical value as a text."""
        few = f"{self.critical_value:.1f} standard errors of so few seeds"
        return "two standard errors" if self.seeds >= MANY_SEEDS else few

    @property
    def is_significant(self) -> bool:
        """Whether the difference exceeds the critical value."""
        return abs(self.mean) > self.critical_value * self.error

    @property
    def description(self) -> str:
        """A text for display."""
        return self.describe()

    def describe(self, *, minimised: bool = False) -> str:
        """The same; of a function that is `minimised`, the difference of its values, whose fitness was paired."""
        if self.mean == self.error == 0:
            return f"bit-identical scores on {self.seeds} equal seeds"
        size = format_with_error(-self.mean if minimised else self.mean, self.error, sign="+")
        found = f"{size} (standard error) on {self.seeds} equal seeds"
        if self.is_significant:
            return f"{found}: {'better' if self.mean > 0 else 'worse'}"
        return f"{found}: not significant, as it is under {self.threshold_text}"


def is_clearly_below(scores: Mapping[int, float], others: Mapping[int, float]) -> bool:
    """Whether `scores` by seed are significantly below `others`; fewer than two common seeds show nothing."""
    if len(scores.keys() & others.keys()) < 2:
        return False
    found = PairedDifference.of(others, scores)
    return found.is_significant and found.mean < 0


def _scores_by_seed(evaluated: EpisodeResults) -> dict[int, float]:
    return dict(zip(evaluated.seeds, evaluated.scores, strict=True))
