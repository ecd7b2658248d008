"""Results of a controller on unseen seeds: a whole episode a seed, and statistics. Pages: export.md, results.md."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from statistics import fmean, median

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.printable import join_some, plural
from dreamfleet.common.runs.standard_error import format_with_error, sample_std, standard_error
from dreamfleet.common.schema.display import Displayed
from dreamfleet.common.schema.validation import OPTIONAL, Count

MAX_NAMED = 3  # failed episodes in a text


@dataclass(frozen=True)
class EpisodeResult:
    """The result of one whole episode; `None` for figures that its environment does not report."""

    seed: Count
    score: float
    steps: Count  # environment steps
    finished: bool | None = None  # whether it completed the course, such as a whole lap
    speed: float | None = None  # mean over its steps, in the environment's unit
    braking: float | None = None  # share of its steps with the brake on
    figures: dict[str, float] | None = field(default=None, metadata=OPTIONAL)  # of its world, by name


@dataclass(frozen=True)
class FailedEpisode:
    """An episode without a score."""

    seed: Count
    error: str  # one line

    def __str__(self) -> str:
        return f"seed {self.seed}, {self.error}"


@dataclass(frozen=True, repr=False)
class EpisodeResults(Displayed):
    """The episodes of one controller, in the order of their seeds; at least one has a score.

    All statistics are over the episodes with a score.

    >>> from dreamfleet import evaluate, find_controller
    >>> results = evaluate(find_controller("cartpole"), episodes=4, first_seed=1, jobs=1)  # a run of yours
    >>> results.seeds
    (1, 2, 3, 4)
    >>> results.worst <= results.mean <= results.best
    True
    """

    drives: tuple[EpisodeResult, ...]
    failed: tuple[FailedEpisode, ...] = ()
    minimised: bool = False  # whether a score is the negated value of a function, which texts show

    def _display(self) -> tuple[str, dict[str, object]]:
        score = format_with_error(self.shown(self.mean), self.error)
        extremes = f"{self.shown(self.worst):zg} to {self.shown(self.best):zg}"
        failed = f", {len(self.failed)} failed" if self.failed else ""
        facts = {
            "mean ± standard error": score,
            "median": self.shown(self.median),
            "worst to best": extremes,
            "episodes": len(self.drives),
            "failed": self.failure_text or None,
            "seeds": f"{self.seeds[0]} to {self.seeds[-1]}",
            "steps": self.steps,
            "finished": self.finished,
        }
        return f"EpisodeResults of {plural(len(self.drives), 'episode')}: {score}, {extremes}{failed}", facts

    @classmethod
    def of(cls, episodes: Iterable[EpisodeResult | FailedEpisode], *, minimised: bool = False) -> EpisodeResults:
        """From episodes in any order; `DreamfleetError` if none has a score."""
        ordered = sorted(episodes, key=lambda each: each.seed)
        failed = tuple(each for each in ordered if isinstance(each, FailedEpisode))
        found = cls(tuple(each for each in ordered if isinstance(each, EpisodeResult)), failed, minimised)
        if not found.drives:
            raise DreamfleetError(f"no episode has a score: {found.failure_text}")
        return found

    def shown(self, score: float) -> float:
        """What texts and pictures show of a score."""
        return 0.0 - score if self.minimised else score  # of zero no negative one

    @property
    def failure_text(self) -> str:
        """How many episodes failed, and the first ones with their errors; empty if none failed."""
        if not self.failed:
            return ""
        total = len(self.drives) + len(self.failed)
        named = join_some([str(each) for each in self.failed], MAX_NAMED)
        return f"{len(self.drives)} of {plural(total, 'episode')}, {len(self.failed)} failed: {named}"

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seed of each episode."""
        return tuple(each.seed for each in self.drives)

    @property
    def scores(self) -> tuple[float, ...]:
        """The score of each episode."""
        return tuple(each.score for each in self.drives)

    @property
    def mean(self) -> float:
        """Mean score."""
        return fmean(self.scores)

    @property
    def std(self) -> float | None:
        """Sample standard deviation of the scores (n - 1); `None` for a single episode."""
        return sample_std(self.scores)

    @property
    def error(self) -> float | None:
        """Standard error of the mean, from the sample standard deviation; `None` for a single episode."""
        return standard_error(self.scores)

    @property
    def median(self) -> float:
        """Median score."""
        return median(self.scores)

    @property
    def worst(self) -> float:
        """The worst score."""
        return min(self.scores)

    @property
    def best(self) -> float:
        """The best score."""
        return max(self.scores)

    @property
    def steps(self) -> int:
        """Environment steps of all episodes."""
        return sum(each.steps for each in self.drives)

    @property
    def finished(self) -> int | None:
        """Number of episodes that completed the course; `None` if the environment does not report it."""
        reported = [each.finished for each in self.drives if each.finished is not None]
        return sum(reported) if reported else None

    @property
    def speed(self) -> float | None:
        """Mean over all steps of all episodes; `None` if the environment does not report it."""
        return _mean_over_steps([(each.speed, each.steps) for each in self.drives])

    @property
    def braking(self) -> float | None:
        """Share of all steps with the brake on; `None` if the environment does not report it."""
        return _mean_over_steps([(each.braking, each.steps) for each in self.drives])

    def above(self, score: float) -> float:
        """Share of the episodes with a higher score."""
        return sum(each > score for each in self.scores) / len(self.scores)


def _mean_over_steps(values: Sequence[tuple[float | None, int]]) -> float | None:
    """The mean of the episodes' values, weighted by their steps; `None` without values."""
    known = [(value, steps) for value, steps in values if value is not None]
    steps = sum(steps for _, steps in known)
    return sum(value * steps for value, steps in known) / steps if steps else None
