"""A disk that keeps what was committed and nothing else, and a journal on it with the real one's interface."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, Protocol

from dreamfleet.common.protocol.host_classes import HostClasses
from dreamfleet.common.protocol.messages import Job, Result
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.coordinator.jobs.confirmation import Finalist
from dreamfleet.coordinator.jobs.evaluation import Evaluation
from dreamfleet.coordinator.jobs.rollout_collection import RolloutCollection
from dreamfleet.coordinator.storage.journal import StoredOpenGeneration
from tests.simulation.violation import Violation

TABLES = ("fact", "generation", "result", "evaluation", "collection")
FOLDER = Path("/simulated/run")


class Disk:
    """Tables that were committed, and files that were written aside; it outlives every coordinator."""

    def __init__(self) -> None:
        self.tables: dict[str, dict[Any, Any]] = {name: {} for name in TABLES}
        self.files: dict[str, bytes] = {}
        self.tables["fact"]["uid"] = "0123456789abcdef" * 2

    @contextmanager
    def atomic_write(self, path: Path) -> Any:
        """As `dreamfleet.common.files.regular_files` has it: whole or not there."""
        file = BytesIO()
        yield file
        self.files[path.name] = file.getvalue()


class Witness(Protocol):
    """Who looks at each row before it is written."""

    def opened(self, number: int, vectors: tuple[bytes, ...]) -> None: ...
    def counted(self, job: Job, result: Result) -> None: ...
    def check_fitness(self, number: int, fitness: list[float]) -> None: ...
    def evaluated(self, generation: int, mean: float, std: float) -> None: ...


class MemoryJournal:
    """One life's view of a disk: what it writes it reads, and what it did not commit is gone with it."""

    def __init__(self, disk: Disk, witness: Witness) -> None:
        self.path = FOLDER / JOURNAL
        self._witness = witness
        self._disk = disk
        self._tables = {name: dict(rows) for name, rows in disk.tables.items()}
        self._pending: list[tuple[str, Any, Any]] = []

    def commit(self) -> None:
        for table, key, row in self._pending:
            _apply(self._disk.tables[table], key, row)
        self._pending.clear()

    def close(self) -> None:
        """Nothing is held."""

    def fact(self, key: str) -> str | None:
        found: str | None = self._tables["fact"].get(key)
        return found

    def set_fact(self, key: str, value: str) -> None:
        self._put("fact", key, value)

    def end(self, why: str) -> None:
        """No rule hangs on when."""
        self.set_fact("ended", why)

    def drop_fact(self, key: str) -> None:
        self._put("fact", key, None)

    def fingerprint(self) -> str | None:
        return self.fact("fingerprint")

    def host_class(self) -> str | None:
        return self.fact("host_class")

    @property
    def classes(self) -> HostClasses:
        """No rule hangs on it."""
        return HostClasses()

    @property
    def effort(self) -> Effort:
        """No rule hangs on it."""
        return Effort()

    @property
    def has_writes(self) -> bool:
        """No rule hangs on the time of a generation, which is written with them."""
        return False

    def set_patience(self, seconds: float) -> None:
        """Nobody else locks it."""

    def take_lock(self) -> None:
        """Nobody else locks it."""

    def set_seconds(self, generation: int, seconds: float) -> None:
        """No rule hangs on it."""

    def add_event(self, text: str) -> None:
        """No rule hangs on it."""

    def workers(self) -> list[str]:
        """Only lasting failures hang on it, and a simulated run pauses instead."""
        return []

    def drop_excessive(self, horizon: int) -> int:
        """No older version wrote here."""
        return 0

    def begin_incarnation(self) -> int:
        number = int(self.fact("incarnation") or 0) + 1
        self.set_fact("incarnation", str(number))
        self.commit()
        return number

    def end_incarnation(self) -> None:
        """No rule hangs on it."""

    def open_generation(self, number: int, state: Any, sigma: float, seeds: Sequence[int], vectors: Any) -> None:
        self._witness.opened(number, tuple(vectors))
        self._insert("generation", number, {"state": state, "seeds": tuple(seeds), "vectors": tuple(vectors)})

    def close_generation(self, closed: StoredGeneration, fitness: Any) -> None:
        row = self._tables["generation"][closed.number]
        if "closed" in row:
            raise Violation("counted twice", f"generation {closed.number} was closed before")
        self._witness.check_fitness(closed.number, fitness.tolist())
        self._put("generation", closed.number, {**row, "closed": closed, "fitness": fitness.tolist()})

    def add_result(
        self, job: Job, result: Result, worker: str, fingerprint: str, incarnation: int, host_class: str = ""
    ) -> None:
        self._witness.counted(job, result)
        self._insert("result", result.digest, (job, result))

    def schedule_evaluation(self, evaluation: Evaluation) -> None:
        self._insert("evaluation", evaluation.generation, (evaluation, None))

    def finish_evaluation(self, generation: int, found: StoredEvaluation | None, failed: int) -> None:
        if found is None or failed:
            raise Violation("raised", "a simulated run pauses where an episode fails")
        self._witness.evaluated(generation, found.mean, found.std)
        evaluation, _ = self._tables["evaluation"][generation]
        self._put("evaluation", generation, (evaluation, found))

    def add_failure(self, job: Job, error: str, workers: Sequence[str], attempts: int) -> None:
        raise Violation("raised", "a simulated run pauses where an episode fails")

    def drop_failures(self, generation: int) -> None:
        """There are none."""

    def drop_failures_of(self, digests: Sequence[bytes]) -> None:
        """There are none."""

    def set_seeds(self, generation: int, seeds: Sequence[int]) -> None:
        """A simulated run pauses at a failure instead."""

    def redraw(self, generation: int, indices: Sequence[int], vectors: Sequence[bytes]) -> None:
        raise Violation("raised", "a simulated run pauses where an episode fails")

    def schedule_collection(self, collection: RolloutCollection) -> None:
        self._insert("collection", collection.generation, collection)

    def scheduled_collections(self) -> list[RolloutCollection]:
        return [row for _, row in sorted(self._tables["collection"].items())]

    def last_generation(self) -> StoredOpenGeneration | None:
        numbers = self._tables["generation"]
        return self.generation(max(numbers)) if numbers else None

    def generation(self, number: int) -> StoredOpenGeneration | None:
        row = self._tables["generation"].get(number)
        if row is None or number < max(self._tables["generation"]) - 1:
            return None
        return StoredOpenGeneration(number, row["state"].packed(), row["seeds"], row["vectors"])

    def read_closed(self) -> tuple[list[StoredGeneration], list[StoredEvaluation]]:
        generations = [row["closed"] for _, row in sorted(self._tables["generation"].items()) if "closed" in row]
        return generations, [done for _, (_, done) in sorted(self._tables["evaluation"].items()) if done]

    def results_of(self, kind: str, generation: int) -> dict[bytes, tuple[float, int]]:
        rows = self._tables["result"].items()
        return {
            digest: (result.fitness, result.steps)
            for digest, (job, result) in rows
            if job.kind == kind and job.generation == generation
        }

    def fitness_of(self, digests: Sequence[bytes]) -> dict[bytes, float]:
        rows = self._tables["result"]
        return {digest: rows[digest][1].fitness for digest in digests if digest in rows}

    def pending_evaluations(self) -> list[Evaluation]:
        return [evaluation for _, (evaluation, done) in sorted(self._tables["evaluation"].items()) if done is None]

    def finalists(self, count: int) -> list[Finalist]:
        first: dict[bytes, Finalist] = {}
        for generation, (each, done) in sorted(self._tables["evaluation"].items()):
            if done is not None:
                first.setdefault(each.vector, Finalist(generation, each.vector, done.episodes, done.mean))
        return sorted(first.values(), key=lambda each: (-each.mean, each.generation))[:count]

    def evaluated_vector(self, generation: int) -> bytes:
        vector: bytes = self._tables["evaluation"][generation][0].vector
        return vector

    def _insert(self, table: str, key: Any, row: Any) -> None:
        """As a table with a primary key does."""
        if key in self._tables[table]:
            raise Violation("counted twice", f"the journal's {table} holds {_key_text(key)} already")
        self._put(table, key, row)

    def _put(self, table: str, key: Any, row: Any) -> None:
        _apply(self._tables[table], key, row)
        self._pending.append((table, key, row))


def _apply(rows: dict[Any, Any], key: Any, row: Any) -> None:
    if row is None:
        rows.pop(key, None)
    else:
        rows[key] = row


def _key_text(key: Any) -> str:
    return key.hex()[:12] if isinstance(key, bytes) else str(key)
