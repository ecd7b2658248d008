"""Evaluations of the mean: whole episodes on the same validation tracks each time. Pure: results in, work out."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.records import StoredEvaluation
from dreamfleet.common.runs.seeds import validation_seeds
from dreamfleet.coordinator.jobs.work import Work, make_work


@dataclass(frozen=True)
class Evaluation:
    """The distribution's mean after `generation`, as float32 bytes, to be driven on `episodes` tracks."""

    generation: int
    vector: bytes
    episodes: int

    def work(self, spec: TaskSpec) -> list[Work]:
        """Its jobs."""
        return make_work(spec, "evaluate", self.generation, 0, self.vector, validation_seeds(self.episodes))


@dataclass
class OpenEvaluation:
    """An evaluation in progress: scores by digest."""

    evaluation: Evaluation
    digests: list[bytes]
    scores: dict[bytes, float]


class Evaluations:
    """A run's evaluations: those in progress, and those that are finished, by generation."""

    def __init__(self, finished: Iterable[StoredEvaluation] = ()) -> None:
        self.finished: dict[int, StoredEvaluation] = {}
        self._open: dict[int, OpenEvaluation] = {}
        self.rows: tuple[StoredEvaluation, ...] = ()  # the finished ones by generation: never changed, but replaced
        self._bests: list[StoredEvaluation] = []  # the best of each row and those before it
        for each in finished:
            self.add(each)

    def __len__(self) -> int:
        return len(self.rows)

    def add(self, each: StoredEvaluation) -> None:
        """Take a finished evaluation; they finish nearly in the order of their generations."""
        place = bisect(self.rows, each.generation, key=lambda row: row.generation)
        self.rows = (*self.rows[:place], each, *self.rows[place:])
        self.finished[each.generation] = each
        del self._bests[place:]
        for row in self.rows[place:]:
            best = self._bests[-1] if self._bests else row
            self._bests.append(row if row.mean > best.mean else best)

    def open(self, evaluation: Evaluation, spec: TaskSpec, known: Mapping[bytes, float]) -> list[Work]:
        """Begin an evaluation of which some scores may be known already; its missing jobs."""
        work = evaluation.work(spec)
        digests = [each.job.digest for each in work]
        asked = {digest for each in self._open.values() for digest in each.digests}
        scores = {digest: known[digest] for digest in digests if digest in known}
        self._open[evaluation.generation] = OpenEvaluation(evaluation, digests, scores)
        return [each for each in work if each.job.digest not in scores and each.job.digest not in asked]

    def record(self, digest: bytes, score: float) -> list[int]:
        """Take one accepted score; the generations whose evaluations it is of.

        A run that has converged evaluates the same mean again: its jobs are the same, and one score is each one's.
        """
        wanting = [generation for generation, each in self._open.items() if digest in each.digests]
        for generation in wanting:
            self._open[generation].scores[digest] = score
        return wanting

    def finish(self, generation: int) -> tuple[StoredEvaluation, bytes] | None:
        """End an evaluation that has all of its scores: what it gave, and the vector; `None` while it has not."""
        each = self._open[generation]
        if len(each.scores) < len(each.digests):
            return None
        scores = np.array([each.scores[digest] for digest in each.digests])
        finished = StoredEvaluation(generation, len(scores), float(scores.mean()), float(scores.std()))
        self.add(finished)
        del self._open[generation]
        return finished, each.evaluation.vector

    def is_open(self, generation: int) -> bool:
        """Whether the evaluation of this generation's mean is in progress."""
        return generation in self._open

    @property
    def open_count(self) -> int:
        """Evaluations in progress."""
        return len(self._open)

    @property
    def progress(self) -> tuple[int, int]:
        """Episodes of those in progress: done, wanted."""
        opened = self._open.values()
        return sum(len(each.scores) for each in opened), sum(len(each.digests) for each in opened)

    @property
    def last(self) -> StoredEvaluation | None:
        """The finished one of the latest generation."""
        return self.rows[-1] if self.rows else None

    @property
    def best(self) -> StoredEvaluation | None:
        """The finished one of the highest mean; of equals the earlier."""
        return self._bests[-1] if self._bests else None

    def have_fallen_behind(self, count: int) -> bool:
        """Whether the last `count` evaluations each lie clearly behind the best before them.

        That is how a dream that is being exploited looks: fitness in the dream goes on rising, reality falls.
        """
        if len(self.rows) <= count:
            return False
        best = self._bests[-count - 1]
        return all(each.is_clearly_below(best) for each in self.rows[-count:])
