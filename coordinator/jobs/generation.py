"""One generation: a population, its jobs, the results so far. Pure: no clock, no transport."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isnan

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.result_bounds import to_finite
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob, make_jobs

KnownResult = tuple[float, int, tuple[float, ...]]
"""Fitness, steps and measures of an episode, NaN for one that failed for good."""
PART_JOBS = 16_384  # jobs that are made at a time, in some 60 ms; docs/explanation/decisions.md


@dataclass(frozen=True)
class CandidateScores:
    """A generation's candidates at one moment: a column each, in the order of the population."""

    generation: int
    done: list[int]  # episodes scored
    wanted: list[int]  # episodes, as far as that is known
    fitness: list[float | None]  # the mean of the scored episodes; `None` before the first


class Generation:
    """A table of scores, a row for each candidate and a column for each episode, and the digest of each place.

    With `racing` all candidates drive the first half of the episodes; after this barrier only the better half of the
    candidates drives the second half. Ties go to the lower index. `run_spec` is the run's specification, if `spec`
    differs from it: in a later stage. In a dream the first `driven` episodes are driven in the real world. R8: a
    candidate of which a wanted episode failed for good has no fitness, needs no more episodes, and ranks last.

    Only wanted places count. A result may be known of a place that is not wanted: of the second half before the
    barrier, or of a candidate that passed an earlier barrier and stays below this one.

    `work` are the jobs that are made so far. With `in_parts` they are those of the first candidates, and `make_more`
    makes the others, so that workers may begin meanwhile; not where vectors are equal.
    """

    def __init__(
        self, number: int, spec: TaskSpec, vectors: Sequence[bytes], seeds: Sequence[int], *, racing: bool = False,
        run_spec: TaskSpec | None = None, driven: int = 0, in_parts: bool = False,
    ) -> None:  # fmt: skip
        self.number = number
        self.spec = spec
        distinct = len(set(vectors))
        self.is_one_point = distinct == 1 < len(vectors)  # compared as float32: nothing can be learned from equal ones
        self.work: list[ScoringJob] = []
        self._vectors = vectors
        self._parts = (spec.with_overrides(driven=True), seeds[:driven], 0), (spec, seeds[driven:], driven)
        self._run_spec = run_spec or spec
        self._made = 0  # candidates whose jobs are made
        # Equal vectors have equal digests: one job then fills the place of each of them.
        self._places: dict[bytes, list[tuple[int, int]]] = {}
        self._shared: list[list[tuple[int, int]]] = []  # the places of each digest that has several
        self._scores = np.full((len(vectors), len(seeds)), np.nan)
        self._first = -(-len(seeds) // 2) if racing else len(seeds)
        self._wanted = np.zeros(self._scores.shape, dtype=bool)
        self._wanted[:, : self._first] = True
        self._steps = np.zeros(self._scores.shape, dtype=np.int64)  # a result's steps stand in each of its places
        self._measures = np.full((*self._scores.shape, len(spec.measures)), np.nan)
        self._lost = np.zeros(self._scores.shape, dtype=bool)  # places whose episode failed for good
        self._failed = np.zeros(len(vectors), dtype=bool)  # candidates, cancelled ones too
        if in_parts and distinct == len(vectors):
            self.make_more()
        else:
            self._make(len(vectors))

    @property
    def unmade(self) -> int:
        """How many wanted jobs are not made yet."""
        return int(self._wanted[self._made :].sum())

    def make_more(self) -> list[ScoringJob]:
        """Make the jobs of further candidates, some `PART_JOBS`; those that are wanted."""
        made = len(self.work)
        self._make(self._made + max(1, PART_JOBS // max(self.episodes, 1)))
        wanted = self._wanted
        return [each for each in self.work[made:] if wanted[each.template.candidate, each.episode]]

    def _make(self, until: int) -> None:
        for candidate, vector in enumerate(self._vectors[self._made : until], self._made):
            for spec, seeds, first in self._parts:
                for work in make_jobs(spec, "score", self.number, candidate, vector, seeds, self._run_spec, first):
                    self.work.append(work)
                    places = self._places.setdefault(work.digest, [])
                    places.append((candidate, work.episode))
                    if len(places) == 2:
                        self._shared.append(places)
        self._made = min(until, len(self._vectors))

    @property
    def steps(self) -> int:
        """Environment steps of the results that count, each once; not those of failed candidates.

        How many episodes of a failed candidate were scored before the failure depends on the fleet.
        """
        counting = self._counting
        counts = [(places[0], sum(bool(counting[place]) for place in places)) for places in self._shared]
        repeated = sum(int(self._steps[first]) * (count - 1) for first, count in counts if count)
        return int(sum(self._steps[counting].tolist())) - repeated

    @property
    def population(self) -> int:
        """How many candidates it has."""
        return len(self._failed)

    @property
    def episodes(self) -> int:
        """How many episodes each candidate has."""
        return self._scores.shape[1]

    def find_scored(self) -> ScoringJob | None:
        """A job that has a score; `None` if there is none."""
        return next(
            (each for each in self.work if np.isfinite(self._scores[each.template.candidate, each.episode])), None
        )

    @property
    def failed(self) -> list[int]:
        """The candidates that failed."""
        return np.flatnonzero((self._lost & self._wanted).any(axis=1)).tolist()

    @property
    def without_fitness(self) -> list[int]:
        """The candidates that failed, and those that were cancelled."""
        return np.flatnonzero(self._failed).tolist()

    @property
    def has_failures(self) -> bool:
        """Whether an episode failed for good, of a place that is wanted or not."""
        return bool(self._lost.any())

    @property
    def all_failed(self) -> bool:
        """Whether no candidate is left."""
        return bool(self._failed.all())

    @property
    def has_bad_seeds(self) -> bool:
        """Whether each candidate failed that was to drive all episodes; in a race these are the better half."""
        whole = self._wanted.all(axis=1)
        return bool(whole.any() and self._failed[whole].all())

    @property
    def missing(self) -> list[ScoringJob]:
        """Wanted jobs without a result, of those that are made, each digest once, candidate by candidate."""
        first = {work.digest: work for work in reversed(self.work)}
        is_open = self._open_places.tolist()
        return [
            first[digest]
            for digest, places in self._places.items()
            if any(is_open[candidate][episode] for candidate, episode in places)
        ]

    @property
    def unwanted(self) -> list[bytes]:
        """Digests of jobs that only failed candidates would need."""
        failed = self._failed
        return [digest for digest, places in self._places.items() if all(failed[row] for row, _ in places)]

    @property
    def counted(self) -> list[ScoringJob]:
        """Jobs whose results count now."""
        scored = (self._counting & np.isfinite(self._scores)).tolist()
        return [each for each in self.work if scored[each.template.candidate][each.episode]]

    @property
    def surplus(self) -> list[bytes]:
        """Digests of results of the second half that this race does not want; empty before the barrier."""
        if not self._is_raced or not self._is_decided:
            return []
        surplus = ((np.isfinite(self._scores) | self._lost) & ~self._wanted).tolist()
        return [digest for digest, ((row, at), *_) in self._places.items() if surplus[row][at]]

    @property
    def done(self) -> int:
        """Episodes scored, without those of failed candidates."""
        return int((self._counting & np.isfinite(self._scores)).sum())

    @property
    def total(self) -> int:
        """Episodes wanted, as far as that is known."""
        return int(self._counting.sum())

    @property
    def complete(self) -> bool:
        """Whether every wanted episode is scored; never without candidates."""
        return self.population > 0 and self.done == self.total

    def record(self, digest: bytes, fitness: float, steps: int, measures: Sequence[float] = ()) -> bool:
        """Record a result of this generation, NaN for an episode that failed for good; whether it decides the barrier.

        R27: the digest names the place that a result fills, so the order of arrival does not matter. A candidate that
        was drawn anew since has no place for it.
        """
        for place in self._places.get(digest, ()):
            self._lost[place] = isnan(fitness)
            self._failed[place[0]] |= self._lost[place] and self._wanted[place]
            self._scores[place] = fitness
            self._steps[place] = steps
            if measures and len(measures) == self._measures.shape[2]:
                self._measures[place] = measures
        return self._open_second_half()

    def cancel(self) -> None:
        """Want no more results: candidates that lack an episode get no fitness."""
        self._failed |= self._open_places.any(axis=1)

    def recall(self, results: Mapping[bytes, KnownResult]) -> None:
        """Record results of an earlier incarnation by digest."""
        for digest in self._places:
            if digest in results:
                self.record(digest, *results[digest])

    def fitness(self) -> NDArray[np.float64]:
        """The fitness of each candidate, `(population,)`: the mean of its wanted episodes, NaN where one failed.

        R27: a mean is taken over a whole row, so any order of results gives the same bits.
        """
        fitness = np.full(len(self._scores), np.nan)
        if not self.all_failed:
            fitness[~self._failed] = np.nanmean(np.where(self._counting, self._scores, np.nan)[~self._failed], axis=1)
        return fitness

    def measures(self) -> NDArray[np.float64] | None:  # docs/how-to/quality-diversity.md
        """The measures of each candidate, `(population, measures)`: means over its wanted episodes, as the fitness.

        NaN where an episode failed; `None` if nothing is measured beside fitness.
        """
        if not self._measures.shape[2]:
            return None
        measures = np.full((self.population, self._measures.shape[2]), np.nan)
        counting = np.where(self._counting[:, :, None], self._measures, np.nan)
        measures[~self._failed] = np.nanmean(counting[~self._failed], axis=1)
        return measures

    def candidate_scores(self, page: slice = slice(None)) -> CandidateScores:
        """The scores of all candidates so far, or of some."""
        counting, scores = self._counting[page], self._scores[page]
        scored = counting & np.isfinite(scores)
        done = scored.sum(axis=1)
        totals = np.where(scored, scores, 0.0).sum(axis=1)
        means = [
            to_finite(total / count) if count else None
            for total, count in zip(totals.tolist(), done.tolist(), strict=True)
        ]
        return CandidateScores(self.number, done.tolist(), counting.sum(axis=1).tolist(), means)

    @property
    def candidates_done(self) -> int:
        """How many candidates have all scores that count."""
        return int((~(self._counting & ~np.isfinite(self._scores)).any(axis=1)).sum())

    @property
    def _counting(self) -> NDArray[np.bool_]:
        """The places whose results count, once they are there."""
        return np.asarray(self._wanted & ~self._failed[:, None])

    @property
    def _open_places(self) -> NDArray[np.bool_]:
        """The places whose results are wanted and missing."""
        return np.asarray(self._counting & np.isnan(self._scores))

    @property
    def _is_raced(self) -> bool:
        return self._first < self._scores.shape[1]

    @property
    def _is_decided(self) -> bool:
        """Whether the barrier of a race is passed."""
        return bool(self._wanted[:, self._first :].any())

    def _open_second_half(self) -> bool:
        if not self._is_raced or self._is_decided or self._open_places.any():
            return False
        first = np.where(self._failed[:, None], -np.inf, self._scores[:, : self._first])
        better = np.argsort(-first.mean(axis=1), kind="stable")[: -(-len(first) // 2)]
        self._wanted[better, self._first :] = True
        for places in self._shared:  # equal vectors have equal scores
            if any(self._wanted[place] for place in places):
                self._wanted[tuple(zip(*places, strict=True))] = True
        self._failed |= (self._lost & self._wanted).any(axis=1)
        return True
