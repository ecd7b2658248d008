"""Evaluations of the mean: whole episodes on the same validation tracks each time. Pure: results in, work out.

R28: an evaluation is computed only from accepted results on fixed tracks, so a restart gives the same value.
"""

from bisect import bisect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import isnan

import numpy as np

from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.paired_difference import is_clearly_below
from dreamfleet.common.runs.records import StoredEvaluation
from dreamfleet.common.runs.seeds import validation_seeds
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob, make_jobs

FindScores = Callable[[int], Mapping[int, float]]
"""Finds the scores of a finished evaluation by seed, from its generation; a seed without a score is missing."""


@dataclass(frozen=True)
class Evaluation:
    """The distribution's mean after `generation`, as float32 bytes, to be driven on `episodes` tracks."""

    generation: int
    vector: bytes
    episodes: int

    def work(self, spec: TaskSpec) -> list[ScoringJob]:
        """The jobs of this evaluation."""
        return make_jobs(spec, "evaluate", self.generation, 0, self.vector, validation_seeds(self.episodes))


@dataclass
class OpenEvaluation:
    """An evaluation in progress: scores by digest."""

    evaluation: Evaluation
    digests: list[bytes]
    scores: dict[bytes, float]

    @property
    def failed(self) -> set[bytes]:
        """Digests of the episodes that failed for good."""
        return {digest for digest, score in self.scores.items() if isnan(score)}


@dataclass(frozen=True)
class FinishedEvaluation:
    """A closed evaluation: its vector, how many episodes failed for good, and its score if any did not."""

    vector: bytes
    failed: int
    found: StoredEvaluation | None


class Evaluations:
    """A run's evaluations: the open and the finished ones, by generation."""

    def __init__(self, finished: Iterable[StoredEvaluation] = ()) -> None:
        self.finished: dict[int, StoredEvaluation] = {}
        self._open: dict[int, OpenEvaluation] = {}
        self.rows: tuple[StoredEvaluation, ...] = ()  # the finished ones by generation; replaced, never changed
        self._bests: list[StoredEvaluation] = []  # for each row the best one up to it
        for each in finished:
            self.add(each)

    def __len__(self) -> int:
        return len(self.rows)

    def add(self, each: StoredEvaluation) -> None:
        """Add a finished evaluation; they finish nearly in the order of their generations."""
        place = bisect(self.rows, each.generation, key=lambda row: row.generation)
        self.rows = (*self.rows[:place], each, *self.rows[place:])
        self.finished[each.generation] = each
        del self._bests[place:]
        for row in self.rows[place:]:
            best = self._bests[-1] if self._bests else row
            self._bests.append(row if row.rank > best.rank else best)

    def open(self, evaluation: Evaluation, spec: TaskSpec, known: Mapping[bytes, float]) -> list[ScoringJob]:
        """Open an evaluation with the scores that are known already; return its missing jobs."""
        work = evaluation.work(spec)
        digests = [each.digest for each in work]
        wanted = {digest for each in self._open.values() for digest in each.digests}
        scores = {digest: known[digest] for digest in digests if digest in known}
        self._open[evaluation.generation] = OpenEvaluation(evaluation, digests, scores)
        return [each for each in work if each.digest not in scores and each.digest not in wanted]

    def record(self, digest: bytes, score: float) -> list[int]:
        """Record one score, NaN for an episode that failed for good; return the generations of its evaluations.

        A run that has converged evaluates the same mean again: the jobs are the same, and each score counts for all.
        """
        waiting = [generation for generation, each in self._open.items() if digest in each.digests]
        for generation in waiting:
            self._open[generation].scores[digest] = score
        return waiting

    def retry_failed(self, spec: TaskSpec) -> list[ScoringJob]:
        """Want the failed episodes of the open evaluations again; their jobs, each once."""
        work = {}
        for each in self._open.values():
            failed = each.failed
            work.update({job.job.digest: job for job in each.evaluation.work(spec) if job.job.digest in failed})
            for digest in failed:
                del each.scores[digest]
        return list(work.values())

    def finish(self, generation: int) -> FinishedEvaluation | None:
        """Close an evaluation whose scores are complete; `None` while some are missing."""
        each = self._open[generation]
        if len(each.scores) < len(each.digests):
            return None
        every = np.array([each.scores[digest] for digest in each.digests])
        scores = every[np.isfinite(every)]  # docs/how-to/export.md
        failed = len(every) - len(scores)
        del self._open[generation]
        if not len(scores):
            return FinishedEvaluation(each.evaluation.vector, failed, None)
        found = StoredEvaluation(generation, len(scores), float(scores.mean()), float(scores.std()), failed)
        self.add(found)
        return FinishedEvaluation(each.evaluation.vector, failed, found)

    def is_open(self, generation: int) -> bool:
        """Whether the evaluation of this generation's mean is open."""
        return generation in self._open

    def digests(self, generation: int) -> list[bytes]:
        """The digests of an open evaluation's jobs."""
        return self._open[generation].digests

    @property
    def scored(self) -> list[int]:
        """Generations of the open evaluations whose scores are complete."""
        return [generation for generation, each in self._open.items() if len(each.scores) == len(each.digests)]

    @property
    def open_count(self) -> int:
        """How many evaluations are open."""
        return len(self._open)

    @property
    def progress(self) -> tuple[int, int]:
        """Episodes of the open evaluations: done, wanted."""
        opened = self._open.values()
        return sum(len(each.scores) for each in opened), sum(len(each.digests) for each in opened)

    @property
    def last(self) -> StoredEvaluation | None:
        """The finished evaluation of the latest generation."""
        return self.rows[-1] if self.rows else None

    @property
    def best(self) -> StoredEvaluation | None:
        """The finished evaluation of the highest rank; of equals the earliest."""
        return self._bests[-1] if self._bests else None

    def have_fallen_behind(self, count: int, find_scores: FindScores) -> bool:  # docs/explanation/dreams.md
        """Whether each of the last `count` evaluations is clearly below the best one before them, paired by seed.

        This shows that the search exploits the dream: fitness in the dream rises while the real score falls.
        """
        if len(self.rows) <= count:
            return False
        best = find_scores(self._bests[-count - 1].generation)
        return all(is_clearly_below(find_scores(each.generation), best) for each in self.rows[-count:])
