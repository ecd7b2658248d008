"""The episodes that each candidate's fitness is the mean of, with their effort. Pages: protocol.md."""

from collections.abc import Collection, Iterable, Iterator, Sequence

from dreamfleet.common.protocol.result_bounds import clamp_count, to_finite
from dreamfleet.common.runs.journal.journal_reader import JournalReader, digest_terms
from dreamfleet.common.runs.records import RunSettings, StoredCandidate, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.stages import StageTracker

RESULTS = "SELECT digest, steps, seconds FROM result WHERE kind = 'score' AND generation = ?"
RECALLED = "SELECT digest, steps, seconds FROM recalled WHERE kind = 'score' AND generation = ? AND was_closed"


class CandidateCounts:
    """Counts what each candidate was scored by, generation by generation in ascending order.

    R1: results are found by their jobs' digests. Those of a discarded vector or of replaced seeds have the same places,
    and are part of the run's effort alone. R8: so are those of a candidate that failed: how many there are depends on
    the fleet. Hence a generation's steps are the sum of its candidates'.
    """

    def __init__(
        self, journal: JournalReader, settings: RunSettings, history: Sequence[StoredGeneration],
        evaluations: Iterable[StoredEvaluation],
    ) -> None:  # fmt: skip
        self._journal, self._history = journal, history
        self._stages = StageTracker(settings)
        self._finished = {each.generation: each for each in evaluations}
        self._shares_results = settings.is_external  # among generations: batches of others repeat jobs

    def rows(self, number: int, seeds: Sequence[int], *, is_open: bool) -> Iterator[StoredCandidate]:
        """The candidates of a generation with its present seeds."""
        query = "SELECT number, vector, fitness FROM candidate WHERE generation = ? ORDER BY number"
        found = self._journal.rows("ibF", query, number)
        stage = self._stages.advance_to(number, self._history, self._finished).stage
        jobs = [*stage.job_digests((vector for _, vector, _ in found), seeds)]
        left = self._results(number)
        scored = {*left, *self._scored_elsewhere({each for own in jobs for each in own} - left.keys(), is_open=is_open)}
        lost = self._failed_jobs(number) if is_open else set()
        for (index, _, fitness), own in zip(found, jobs, strict=True):
            is_failed = not lost.isdisjoint(own) if is_open else fitness is None
            episodes = [] if is_failed else [each for each in own if each in scored]
            made = [left.pop(each) for each in episodes if each in left]  # equal candidates share their episodes
            steps, seconds = sum(each for each, _ in made), sum((to_finite(each) for _, each in made), 0.0)
            yield StoredCandidate(number, index, fitness, len(episodes), clamp_count(steps), to_finite(seconds))

    def _results(self, number: int) -> dict[bytes, tuple[int, float]]:
        """Steps and seconds of a generation's results, by job; of a closed batch also of those that were recalled.

        What was handed out of a complete batch stays, so its candidates keep what they were scored by.
        """
        results = self._journal.rows("bif", RESULTS, number)
        if self._shares_results:
            results = self._journal.rows("bif", RECALLED, number) + results
        return {digest: (steps, seconds) for digest, steps, seconds in results}

    def _failed_jobs(self, number: int) -> set[bytes]:
        """The jobs of an open generation that failed for good."""
        query = "SELECT digest FROM failure WHERE kind = 'score' AND generation = ?"
        return {digest for (digest,) in self._journal.rows("b", query, number)}

    def _scored_elsewhere(self, missing: Collection[bytes], *, is_open: bool) -> Iterator[bytes]:
        """Those of these jobs that another batch brought, in a closed one all; their effort is of its generation."""
        if not is_open and self._shares_results:
            yield from missing
        elif self._shares_results:
            for these, some in digest_terms([*missing]):
                query = f"SELECT DISTINCT digest FROM result WHERE kind = 'score' AND {these}"  # noqa: S608
                yield from (digest for (digest,) in self._journal.rows("b", query, *some))
