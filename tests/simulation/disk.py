"""A disk that keeps what was committed: the product's own journal on a database in memory, and files."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np

from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.protocol.messages import Job, Result
from dreamfleet.common.runs.journal import schema
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.coordinator.storage.verification_records import VERIFY_KEY
from tests.simulation.violation import Violation

if TYPE_CHECKING:
    from tests.simulation.witness import Witness

FOLDER = Path("/simulated/run")
FACTS = {"uid": "0123456789abcdef" * 2, VERIFY_KEY: b"a secret".hex()}  # a play is the same every time
DURABLE = "SELECT digest FROM result UNION ALL SELECT digest FROM recalled WHERE because = 'surplus'"


class Disk:
    """It outlives every coordinator: tables, and files that were written aside."""

    def __init__(self) -> None:
        self.connection = sqlite3.connect(":memory:")
        schema.create_tables(self.connection)
        self.connection.executemany("INSERT INTO run (key, value) VALUES (?, ?)", FACTS.items())
        self.connection.commit()
        self.files: dict[str, bytes] = {}
        self.jobs: dict[bytes, Job] = {}  # by digest, each whose result was ever written
        self.committed()

    def read(self, query: str, *values: Any) -> list[Any]:
        """All rows of a query, also what the coordinator that lives has not committed."""
        return self.connection.execute(query, values).fetchall()

    @property
    def evaluations(self) -> list[StoredEvaluation]:
        """Those that are finished."""
        rows = self.read("SELECT generation, episodes, mean, std FROM evaluation WHERE mean IS NOT NULL ORDER BY 1")
        return [StoredEvaluation(*row) for row in rows]

    def committed(self) -> None:
        """Note of which results a verdict may speak, and which hosts stay barred, if a crash comes now."""
        self.durable = {digest for (digest,) in self.read(DURABLE)}
        self.barred = {host for (host,) in self.read("SELECT host FROM barred")}

    def crash(self) -> None:
        """Lose what is not committed."""
        self.connection.rollback()

    @contextmanager
    def atomic_write(self, path: Path) -> Iterator[BytesIO]:
        """As `dreamfleet.common.files.atomic_write` has it: whole or not there."""
        file = BytesIO()
        yield file
        self.files[path.name] = file.getvalue()


class SimulatedJournal(Journal):
    """The journal of one life on a disk; the witness sees each row before it is written."""

    def __init__(self, disk: Disk, witness: Witness) -> None:
        self._disk, self._witness = disk, witness
        opened = patch.object(sqlite3, "connect", lambda *_, **__: disk.connection)
        with opened, patch.object(schema, "check_schema"):
            super().__init__(FOLDER / JOURNAL)
        _see(self.results, "add", self._see_result)
        _see(self.verification, "add", _see_check)

    def _see_result(self, job: Job, result: Result, *_: object) -> None:
        self._witness.counted(job, result.fitness)
        self._disk.jobs[job.digest] = job

    @staticmethod
    def verify(folder: Path) -> None:
        """Nobody else writes on a simulated disk."""

    def _current_log_size(self) -> None:
        """There is no log."""

    def commit(self) -> None:
        if self.has_writes:
            super().commit()
            self._disk.committed()

    def read_closed(self) -> tuple[list[StoredGeneration], list[StoredEvaluation]]:
        columns = "number, mean, std, best, worst, sigma, steps, seconds, failed"
        rows = self._disk.read(f"SELECT {columns} FROM generation WHERE closed IS NOT NULL ORDER BY 1")
        return [StoredGeneration(*row) for row in rows], self._disk.evaluations

    def open_generation(self, number: int, state: Any, sigma: float, seeds: Sequence[int], vectors: Any) -> None:
        self._witness.opened(number, tuple(vectors))
        super().open_generation(number, state, sigma, seeds, vectors)

    def close_generation(self, closed: StoredGeneration, fitness: Any, measures: Any = None) -> None:
        if self.is_closed(closed.number):
            raise Violation("counted twice", f"generation {closed.number} was closed before")
        self._witness.check_fitness(closed.number, [None if np.isnan(each) else each for each in fitness.tolist()])
        super().close_generation(closed, fitness, measures)

    def finish_evaluation(self, generation: int, found: StoredEvaluation | None, failed: int) -> None:
        if found is None or failed:
            raise Violation("raised", "a simulated run pauses where an episode fails")
        self._witness.evaluated(generation, found.mean, found.std)
        super().finish_evaluation(generation, found, failed)

    def add_failure(self, job: Job, error: Failure, workers: Sequence[str], attempts: int) -> None:
        self._witness.failed(job)
        super().add_failure(job, error, workers, attempts)

    def redraw(self, generation: int, indices: Sequence[int], vectors: Sequence[bytes]) -> None:
        super().redraw(generation, indices, vectors)
        self._witness.redrawn(generation, len(self.redraws_of(generation)), self.vectors_of(generation))


def _see(records: object, name: str, look: Callable[..., None]) -> None:
    """Let `look` see what a method gets before it is called."""
    call = getattr(records, name)

    def seen(*given: Any) -> Any:
        look(*given)
        return call(*given)

    setattr(records, name, seen)


def _see_check(_job: Job, worker: str, checker: str, outcome: str) -> None:
    if outcome != "unchecked" and checker in ("", host_of(worker)):
        raise Violation("checked", f"{worker} checked its own result")
