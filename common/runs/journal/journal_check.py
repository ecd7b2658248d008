"""Whether a journal is what was written: SQLite's own check, checksums, and sums of what belongs together."""

from collections.abc import Callable, Sequence
from math import isclose
from statistics import fmean
from typing import Any

from dreamfleet.common.protocol.result_bounds import clamp_count, to_finite
from dreamfleet.common.runs.journal import checksums
from dreamfleet.common.runs.journal.candidate_counts import CandidateCounts
from dreamfleet.common.runs.journal.journal_reader import JournalReader
from dreamfleet.common.runs.records import StoredCandidate, StoredGeneration

TOLERANCE = 1e-9  # of a mean, as a part of the largest fitness: the writer summed in another order
STRAY = (
    "SELECT 1 FROM result WHERE kind NOT IN ('score', 'evaluate', 'collect') "
    "OR generation NOT IN (SELECT number FROM generation) LIMIT 1"
)


class JournalCheck:
    """Compares what is read from a journal with its checksums; `DamagedJournalError` where it differs.

    What has no checksum, because it is open, is not compared.
    """

    def __init__(self, journal: JournalReader) -> None:
        self._journal = journal
        self._is_record_checked = False

    def check_record(self) -> None:
        """Compare the run's facts, once."""
        if self._is_record_checked:
            return
        facts: list[tuple[str, str]] = self._journal.rows("ss", "SELECT key, value FROM run")
        written = dict(facts).get(checksums.RECORD)
        if written is not None and written != checksums.record_checksum(facts):
            raise self._journal.damage_error("the run's record differs from its checksum")
        self._is_record_checked = True

    def check_generations(self, since: int = 0) -> list[tuple[Any, ...]]:
        """Compare the rows of the closed generations; without what belongs to them."""
        return self._check_rows("generation", f"{checksums.GENERATION_ROW} AND number >= ? ORDER BY number", since)

    def check_evaluations(self) -> list[tuple[Any, ...]]:
        """Compare the rows of the evaluations; without their results."""
        return self._check_rows("evaluation", f"{checksums.EVALUATION_ROW} ORDER BY generation")

    def _check_rows(self, what: str, query: str, *values: int) -> list[tuple[Any, ...]]:
        rows = self._journal.read(query, *values)
        for row in rows:
            if not checksums.is_row_sound(row):
                raise self._journal.damage_error(f"{what} {row[0]} differs from its checksum")
        return rows

    def check_state(self) -> None:
        """Compare the strategy's states."""
        query = "SELECT generation, state, checksum FROM strategy"
        for number, state, written in self._journal.rows("ibn", query):
            if written not in (None, checksums.state_checksum(number, state)):
                raise self._journal.damage_error(f"the optimiser's state of {number} differs from its checksum")

    def check_all(
        self, history: Sequence[StoredGeneration], counts: CandidateCounts, seeds_of: Callable[[int], Sequence[int]]
    ) -> None:
        """Compare everything, and the sums of what has a checksum."""
        ((text,),) = self._journal.read("PRAGMA integrity_check(1)")
        if text != "ok":
            raise self._journal.damage_error(str(text))
        self.check_record()
        self.check_state()
        sealed = set()
        for row in self.check_generations():
            self._check_parts("generation", row, checksums.generation_parts)
            sealed |= {row[0]} if row[-1] is not None else set()
        for row in self.check_evaluations():
            self._check_parts("evaluation", row, checksums.evaluation_parts)
        self._check_ends()
        for number, each in enumerate(history):
            if each.number != number:
                raise self._journal.damage_error(f"generation {number} is missing")
            if number in sealed:
                self._check_sums(each, [*counts.rows(number, seeds_of(number), is_open=False)])

    def _check_parts(self, what: str, row: tuple[Any, ...], parts: Callable[[checksums.Read, int], bytes]) -> None:
        if row[-1] is not None and parts(self._journal.read, row[0]) != row[-1][checksums.SIZE :]:
            raise self._journal.damage_error(f"what belongs to {what} {row[0]} differs from its checksum")

    def _check_ends(self) -> None:
        """Compare what belongs to no generation, and that the last generation has the strategy's state before it."""
        sealed = self._journal.fact(checksums.SEALED)
        if sealed is not None and sealed != checksums.sealed_text(self._journal.read):
            raise self._journal.damage_error("generations or evaluations are missing")
        if self._journal.row(STRAY):
            raise self._journal.damage_error("a result belongs to no generation")
        rest = self._journal.fact(checksums.REST)
        if rest is not None and rest != checksums.rest_checksum(self._journal.read):
            raise self._journal.damage_error("what belongs to no generation differs from its checksum")
        if self._journal.row("SELECT max(number) FROM generation") != self._journal.row(
            "SELECT max(generation) FROM strategy"
        ):
            raise self._journal.damage_error("its last generation is missing")

    def _check_sums(self, closed: StoredGeneration, candidates: Sequence[StoredCandidate]) -> None:
        """Compare a generation's statistics with its candidates'."""
        fitness = [to_finite(each.fitness) for each in candidates if each.fitness is not None]
        steps = clamp_count(sum(each.steps for each in candidates))
        is_sound = steps == closed.steps
        if fitness:
            is_sound &= (max(fitness), min(fitness)) == (closed.best, closed.worst)
            largest = max(map(abs, fitness))  # of which the rounding of a sum is a part, also where the mean is near 0
            is_sound &= isclose(fmean(fitness), closed.mean, abs_tol=TOLERANCE * max(largest, 1.0))
        if not is_sound:
            raise self._journal.damage_error(f"generation {closed.number} is not the sum of its results")
