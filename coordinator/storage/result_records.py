"""The accepted results in a journal, by generation or by their jobs' digests, and their totals. Pages: export.md."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from math import nan
from typing import Any

from dreamfleet.common.protocol.host_classes import HostClasses, count_results
from dreamfleet.common.protocol.messages import Job, Kind, Result
from dreamfleet.common.protocol.result_bounds import to_finite
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.journal.journal_reader import CLASS_COUNTS_QUERY, digest_terms, efforts_query
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.stages import begun_stages
from dreamfleet.coordinator.jobs.generation import KnownResult
from dreamfleet.coordinator.storage.journal_connection import JournalConnection

COLUMNS = (
    "digest, kind, generation, candidate, episode, seed, fitness, steps, seconds, worker, fingerprint, incarnation, "
    "host_class, measures"
)
ADD = f"INSERT INTO result ({COLUMNS}) VALUES ({', '.join('?' * len(COLUMNS.split(', ')))})"  # noqa: S608


class ResultRecords:
    """Reads and writes a journal's results, and the failures of jobs that have none."""

    def __init__(self, journal: JournalConnection) -> None:
        self._journal = journal
        self.indices: dict[Kind, str] = {"evaluate": "evaluation_digest"}  # of kinds that are found by digests
        self._effort: Effort | None = None  # of every result, once somebody asked
        self._counted: Counter[tuple[str, str]] | None = None  # results by class and fingerprint, likewise

    def add(self, job: Job, result: Result, worker: str, fingerprint: str, incarnation: int, host_class: str) -> None:
        """Write an accepted result."""
        self._journal.write(
            ADD, job.digest, job.kind, job.generation, job.candidate, job.episode, job.seeds[0], result.fitness,
            result.steps, result.seconds, worker, fingerprint, incarnation, host_class,
            json.dumps(result.measures) if result.measures else None,
        )  # fmt: skip
        if self._counted is not None:
            self._counted[host_class, fingerprint] += 1
        if self._effort is not None:
            made = result.steps, int(result.seconds * 1e6)
            self._effort += Effort.of(job.task, job.kind, *made, driven=bool(job.driven))

    @property
    def effort(self) -> Effort:
        """The effort of all results: summed once, then counted with each, so that its cost does not grow."""
        if self._effort is None:
            settings = RunSettings.from_json(self._journal.fact("settings") or "")
            with RunFolder(self._journal.path.parent) as folder:
                begun = begun_stages(settings, folder.history(), folder.evaluations())
            task, rows = settings.task.task, self._journal.read(efforts_query(begun))
            efforts = (Effort.of(task, kind, *made, driven=bool(driven)) for kind, _, _, driven, *made in rows)
            self._effort = sum(efforts, Effort())
        return self._effort

    @property
    def classes(self) -> HostClasses:
        """The host classes of all results: read once, then counted with each."""
        if self._counted is None:
            self._counted = count_results(self._journal.read(CLASS_COUNTS_QUERY))
        return HostClasses.of(self._counted)

    def forget_totals(self) -> None:
        """Sum effort and classes anew when they are next asked for: results were moved."""
        self._effort = self._counted = None

    def workers(self, *, recalled: bool = False) -> list[str]:
        """The workers that have scored jobs of the run; with `recalled` also those whose results count no more."""
        query = "SELECT DISTINCT worker FROM result"
        if recalled:
            query += " UNION SELECT worker FROM recalled"
        return [str(worker) for (worker,) in self._journal.read(query)]

    def of(self, kind: str, generation: int) -> dict[bytes, KnownResult]:
        """Fitness, steps and measures of a generation's results, by digest; NaN for what failed for good."""
        query = "SELECT digest, fitness, steps, measures FROM result WHERE kind = ? AND generation = ?"
        found: dict[bytes, KnownResult] = {
            digest: (to_finite(fitness), steps, tuple(json.loads(measures or "[]")))
            for digest, fitness, steps, measures in self._journal.read(query, kind, generation)
        }
        query = "SELECT digest FROM failure WHERE kind = ? AND generation = ?"
        return found | {digest: (nan, 0, ()) for (digest,) in self._journal.read(query, kind, generation)}

    def index_scores(self) -> None:
        """Let candidates' episodes be found by their digests alone, too: batches of others repeat them."""
        self._journal.write("CREATE INDEX IF NOT EXISTS score_digest ON result (digest) WHERE kind = 'score'")
        self.indices["score"] = "score_digest"

    def with_digests(
        self, kind: Kind, columns: str, digests: Sequence[bytes], also: str = ""
    ) -> Iterator[tuple[Any, ...]]:
        """Read these columns of the results of a kind with these digests, whichever generation asked for them.

        The index is named, because SQLite would read all results of the kind.
        """
        query = f"SELECT {columns} FROM result INDEXED BY {self.indices[kind]} WHERE kind = '{kind}'"  # noqa: S608
        for these, some in digest_terms(digests):
            yield from self._journal.read(f"{query} AND {these} {also}", *some)

    def fitness_of(self, kind: Kind, digests: Sequence[bytes]) -> dict[bytes, float]:
        """Fitness of those of these jobs that have a result, whichever generation asked for it.

        NaN for those that failed for good. Of candidates' episodes, only after `index_scores`.
        """
        found: dict[bytes, float] = dict(self.with_digests(kind, "digest, fitness", digests))
        return found | dict.fromkeys(self.errors_of(digests), nan)

    def errors_of(self, digests: Sequence[bytes]) -> dict[bytes, str]:
        """Why those of these jobs failed that failed for good."""
        found: dict[bytes, str] = {}
        for these, some in digest_terms(digests):
            found.update(self._journal.read(f"SELECT digest, error FROM failure WHERE {these}", *some))  # noqa: S608
        return found
