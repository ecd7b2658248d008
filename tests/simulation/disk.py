"""A disk that keeps what was committed and nothing else, and a journal on it with the real one's interface."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec.structs import replace

from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.host_classes import HostClasses
from dreamfleet.common.protocol.messages import Job, Kind, Result
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.records import StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.common.runs.seeds import CHOOSING_OFFSET
from dreamfleet.coordinator.dispatch.failures import host_of
from dreamfleet.coordinator.jobs.checks import Answer
from dreamfleet.coordinator.jobs.confirmation import Finalist
from dreamfleet.coordinator.jobs.evaluation import Evaluation
from dreamfleet.coordinator.jobs.generation import KnownResult
from dreamfleet.coordinator.jobs.rollout_collection import RolloutCollection
from dreamfleet.coordinator.jobs.work import Work
from dreamfleet.coordinator.storage.journal import StoredOpenGeneration
from dreamfleet.coordinator.storage.verification_records import StoredAnswer, StoredBar
from tests.simulation.violation import Violation

if TYPE_CHECKING:
    from tests.simulation.witness import Witness

TABLES = ("fact", "generation", "result", "failure", "evaluation", "collection", "verification", "barred", "recalled")
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


class MemoryTables:
    """One life's view of a disk's tables, which its journal's parts share."""

    def __init__(self, disk: Disk, witness: Witness) -> None:
        self.witness = witness
        self._disk = disk
        self.rows = {name: dict(rows) for name, rows in disk.tables.items()}
        self._pending: list[tuple[str, Any, Any]] = []

    def commit(self) -> None:
        for table, key, row in self._pending:
            _apply(self._disk.tables[table], key, row)
        self._pending.clear()

    def insert(self, table: str, key: Any, row: Any) -> None:
        """As a table with a primary key does."""
        if key in self.rows[table]:
            raise Violation("counted twice", f"the journal's {table} holds {_key_text(key)} already")
        self.put(table, key, row)

    def put(self, table: str, key: Any, row: Any) -> None:
        _apply(self.rows[table], key, row)
        self._pending.append((table, key, row))


@dataclass(frozen=True)
class MemoryResults:
    """The twin of `ResultRecords`."""

    tables: MemoryTables

    def add(self, job: Job, result: Result, worker: str, fingerprint: str, incarnation: int, host_class: str) -> None:
        self.tables.witness.counted(job, result)
        self.tables.insert("result", result.digest, (job, result, worker, host_class))

    def workers(self, *, recalled: bool = False) -> list[str]:
        rows = list(self.tables.rows["result"].values())
        rows += [row for _, row in self.tables.rows["recalled"].values() if recalled]
        return sorted({worker for _, _, worker, _ in rows})

    @property
    def classes(self) -> HostClasses:
        """No rule hangs on it."""
        return HostClasses()

    @property
    def effort(self) -> Effort:
        """No rule hangs on it."""
        return Effort()

    def of(self, kind: str, generation: int) -> dict[bytes, KnownResult]:
        results, failures = self.tables.rows["result"].values(), self.tables.rows["failure"].values()
        found = [(job, (each.fitness, each.steps, each.measures)) for job, each, *_ in results]
        found += [(job, (nan, 0, ())) for job, _ in failures]
        return {job.digest: known for job, known in found if (job.kind, job.generation) == (kind, generation)}

    def fitness_of(self, kind: Kind, digests: Sequence[bytes]) -> dict[bytes, float]:
        rows = self.tables.rows["result"]
        failed = {digest: nan for digest in digests if digest in self.tables.rows["failure"]}
        return {digest: rows[digest][1].fitness for digest in digests if digest in rows} | failed

    def index_scores(self) -> None:
        """Nothing is searched."""


@dataclass(frozen=True)
class MemoryVerification:
    """The twin of `VerificationRecords`."""

    tables: MemoryTables

    def key(self) -> bytes:
        return b"a secret"  # a play is the same every time

    def add(self, job: Job, worker: str, checker: str, outcome: str) -> None:
        if outcome != "unchecked" and checker in ("", host_of(worker)):
            raise Violation("checked", f"{worker} checked its own result")
        self.tables.put("verification", job.digest, (job, worker, checker, outcome))

    def counts(self) -> Counter[str]:
        return Counter(outcome for *_, outcome in self.tables.rows["verification"].values())

    def unverified(self, jobs: Sequence[Job]) -> dict[bytes, StoredAnswer]:
        rows, known = self.tables.rows["result"], self.tables.rows["verification"]
        return {
            digest: StoredAnswer(worker, host_class, Answer.of(host_of(worker), result))
            for digest in (job.digest for job in jobs)
            if digest in rows and digest not in known
            for _, result, worker, host_class in (rows[digest],)
        }

    def barred(self) -> dict[str, StoredBar]:
        return dict(self.tables.rows["barred"])

    def bar(self, host: str, bar: StoredBar, incarnation: int) -> None:
        self.tables.put("barred", host, bar)

    def unbar(self, host: str) -> None:
        self.tables.put("barred", host, None)


@dataclass(frozen=True)
class MemoryRecalls:
    """The twin of `RecallRecords`."""

    tables: MemoryTables

    def first_brought(self, hosts: Collection[str]) -> dict[str, int]:
        first: dict[str, int] = {}
        brought = [job for job, _, worker, _ in self.tables.rows["result"].values() if host_of(worker) in hosts]
        failed = [job for job, _ in self._failures_of(hosts).values()]
        for job in (*brought, *failed, *self._confirmed_by(hosts)):
            kind = _kind_of(job)
            first[kind] = min(job.generation, first.get(kind, job.generation))
        return first

    def _confirmed_by(self, hosts: Collection[str]) -> list[Job]:
        rows = self.tables.rows["verification"].values()
        return [job for job, _, checkers, outcome in rows
                if outcome != "unchecked" and {*checkers.split(",")} <= {*hosts}]  # fmt: skip

    def _failures_of(self, hosts: Collection[str]) -> dict[bytes, Any]:
        return {
            digest: row for digest, row in self.tables.rows["failure"].items() if set(hosts) & {*map(host_of, row[1])}
        }

    def recall(self, hosts: Collection[str]) -> int:
        mine = {digest: row for digest, row in self.tables.rows["result"].items() if host_of(row[2]) in hosts}
        jobs = [*(row[0] for row in mine.values()), *self._confirmed_by(hosts)]
        reopened = {job.generation for job in jobs if _kind_of(job) == "evaluate"}
        vectors = {each.vector for number, (each, _) in self.tables.rows["evaluation"].items() if number in reopened}
        for number, (evaluation, _) in list(self.tables.rows["evaluation"].items()):
            if evaluation.vector in vectors:
                self.tables.put("evaluation", number, (evaluation, None))
        for digest in self._failures_of(hosts):
            self.tables.put("failure", digest, None)
        for digest, row in mine.items():
            self._set_aside("barred", digest, row)
        for key, (_, row) in list(self.tables.rows["recalled"].items()):
            if host_of(row[2]) in hosts:
                self.tables.put("recalled", key, ("barred", row))
        for digest, (job, worker, checker, outcome) in list(self.tables.rows["verification"].items()):
            left = ",".join(each for each in checker.split(",") if each not in hosts)
            is_void = outcome != "unchecked" and not left
            kept = None if is_void or digest not in self.tables.rows["result"] else (job, worker, left, outcome)
            self.tables.put("verification", digest, kept)
        self._settle_recall()
        return len(mine)

    def _set_aside(self, because: str, digest: bytes, row: Any) -> None:
        self.tables.put("recalled", (digest, row[2]), (because, row))
        self.tables.put("result", digest, None)

    def _settle_recall(self) -> None:
        for fact in ("ending", "stop_kind", "ended", "ended_at", "confirmed"):
            self.tables.put("fact", fact, None)

    def set_surplus_aside(self, generation: int, digests: Sequence[bytes]) -> None:
        for digest in digests:
            self.tables.put("failure", digest, None)
            if digest in self.tables.rows["result"]:
                self._set_aside("surplus", digest, self.tables.rows["result"][digest])

    def rewind(self, number: int, state: Any, seeds: Sequence[int]) -> None:
        for (digest, worker), (because, row) in list(self.tables.rows["recalled"].items()):
            if because == "surplus" and row[0].generation == number:
                self.tables.put("recalled", (digest, worker), None)
                self.tables.put("result", digest, row)
            elif because == "surplus" and row[0].generation > number:
                self.tables.put("recalled", (digest, worker), ("rewound", row))
        for digest, row in list(self.tables.rows["result"].items()):
            if _is_behind(row[0], number):
                self._set_aside("rewound", digest, row)
        for digest, (job, _) in list(self.tables.rows["failure"].items()):
            if _is_behind(job, number):
                self.tables.put("failure", digest, None)
        for table in ("evaluation", "collection"):
            for each in [each for each in self.tables.rows[table] if each >= number]:
                self.tables.put(table, each, None)
        for each in [each for each in self.tables.rows["generation"] if each > number]:
            self.tables.put("generation", each, None)
        first = self.tables.rows["generation"][number]["first"]
        self.tables.put("generation", number, {"state": state, "seeds": tuple(seeds), **_asked(first)})
        self._settle_recall()

    @property
    def has_set_aside(self) -> bool:
        return any(because == "rewound" for because, _ in self.tables.rows["recalled"].values())

    def count_again(self, work: Iterable[Work]) -> None:
        wanted = {each.digest: each.template.generation for each in work}
        found = {digest: (key, row) for key, (because, row) in self.tables.rows["recalled"].items()
                 for digest in [key[0]] if because == "rewound" and digest in wanted}  # fmt: skip
        for digest, (key, (job, *brought)) in found.items():
            self.tables.put("recalled", key, None)
            if digest not in self.tables.rows["result"]:
                self.tables.put("result", digest, (replace(job, generation=wanted[digest]), *brought))

    def rollouts(self) -> list[tuple[int, int]]:
        """Nothing reads them, and the simulated folder is not there."""
        return []


class MemoryJournal:
    """One life's view of a disk: what it writes it reads, and what it did not commit is gone with it."""

    def __init__(self, disk: Disk, witness: Witness) -> None:
        self.path = FOLDER / JOURNAL
        self.tables = MemoryTables(disk, witness)
        self.results = MemoryResults(self.tables)
        self.verification = MemoryVerification(self.tables)
        self.recalls = MemoryRecalls(self.tables)

    def _ignored(self, *_: object, **__: object) -> None:
        """No rule hangs on it, and nobody else locks or reads the simulated folder."""

    verify = close = set_patience = take_lock = set_seconds = add_event = end_incarnation = _ignored

    def commit(self) -> None:
        self.tables.commit()

    def fact(self, key: str) -> str | None:
        found: str | None = self.tables.rows["fact"].get(key)
        return found

    def set_fact(self, key: str, value: str) -> None:
        self.tables.put("fact", key, value)

    def end(self, why: str) -> None:
        """No rule hangs on when."""
        self.set_fact("ended", why)

    def drop_fact(self, key: str) -> None:
        self.tables.put("fact", key, None)

    def fingerprint(self) -> str | None:
        return self.fact("fingerprint")

    def host_class(self) -> str | None:
        return self.fact("host_class")

    @property
    def has_writes(self) -> bool:
        """No rule hangs on the time of a generation, which is written with them."""
        return False

    def begin_incarnation(self) -> int:
        number = int(self.fact("incarnation") or 0) + 1
        self.set_fact("incarnation", str(number))
        self.commit()
        return number

    def open_generation(self, number: int, state: Any, sigma: float, seeds: Sequence[int], vectors: Any) -> None:
        self.tables.witness.opened(number, tuple(vectors))
        self.tables.insert("generation", number, {"state": state, "seeds": tuple(seeds), **_asked(tuple(vectors))})

    def close_generation(self, closed: StoredGeneration, fitness: Any, measures: Any = None) -> None:
        row = self.tables.rows["generation"][closed.number]
        if "closed" in row:
            raise Violation("counted twice", f"generation {closed.number} was closed before")
        found = [None if np.isnan(each) else each for each in fitness.tolist()]
        self.tables.witness.check_fitness(closed.number, found)
        self.tables.put("generation", closed.number, {**row, "closed": closed, "fitness": found})

    def vectors_of(self, number: int) -> tuple[bytes, ...]:
        vectors: tuple[bytes, ...] = self.tables.rows["generation"][number]["vectors"]
        return vectors

    def redraws_of(self, number: int) -> list[list[int]]:
        return [list(each) for each in self.tables.rows["generation"][number]["redrawn"]]

    def seeds_of(self, number: int) -> list[int]:
        return list(self.tables.rows["generation"][number]["seeds"])

    def scores_of(self, number: int, axes: int) -> tuple[Any, Any]:
        return np.array(self.tables.rows["generation"][number]["fitness"], dtype=np.float64), None

    def schedule_evaluation(self, evaluation: Evaluation) -> None:
        self.tables.insert("evaluation", evaluation.generation, (evaluation, None))

    def finish_evaluation(self, generation: int, found: StoredEvaluation | None, failed: int) -> None:
        if found is None or failed:
            raise Violation("raised", "a simulated run pauses where an episode fails")
        self.tables.witness.evaluated(generation, found.mean, found.std)
        evaluation, _ = self.tables.rows["evaluation"][generation]
        self.tables.put("evaluation", generation, (evaluation, found))

    def add_failure(self, job: Job, error: Failure, workers: Sequence[str], attempts: int) -> None:
        self.tables.witness.failed(job)
        self.tables.insert("failure", job.digest, (job, tuple(workers)))

    def drop_failures(self, generation: int) -> None:
        jobs = [job for job, _ in self.tables.rows["failure"].values()]
        self.drop_failures_of([job.digest for job in jobs if (job.kind, job.generation) == ("score", generation)])

    def drop_failures_of(self, digests: Sequence[bytes]) -> None:
        for digest in digests:
            self.tables.put("failure", digest, None)

    def set_seeds(self, generation: int, seeds: Sequence[int]) -> None:
        self.tables.put("generation", generation, {**self.tables.rows["generation"][generation], "seeds": tuple(seeds)})

    def redraw(self, generation: int, indices: Sequence[int], vectors: Sequence[bytes]) -> None:
        row, new = self.tables.rows["generation"][generation], dict(zip(indices, vectors, strict=True))
        now = tuple(new.get(index, vector) for index, vector in enumerate(row["vectors"]))
        rounds = (*row["redrawn"], tuple(indices))
        self.tables.witness.redrawn(generation, len(rounds), now)
        self.tables.put("generation", generation, {**row, "vectors": now, "redrawn": rounds})

    def schedule_collection(self, collection: RolloutCollection) -> None:
        self.tables.insert("collection", collection.generation, collection)

    def scheduled_collections(self) -> list[RolloutCollection]:
        return [row for _, row in sorted(self.tables.rows["collection"].items())]

    def last_generation(self) -> StoredOpenGeneration | None:
        numbers = self.tables.rows["generation"]
        return self.generation(max(numbers)) if numbers else None

    def generation(self, number: int) -> StoredOpenGeneration | None:
        row = self.tables.rows["generation"].get(number)
        if row is None or number < max(self.tables.rows["generation"]) - 1:
            return None
        state = row["state"] if isinstance(row["state"], bytes) else row["state"].packed()
        return StoredOpenGeneration(number, state, row["seeds"], row["vectors"], row["redrawn"])

    def read_closed(self) -> tuple[list[StoredGeneration], list[StoredEvaluation]]:
        generations = [row["closed"] for _, row in sorted(self.tables.rows["generation"].items()) if "closed" in row]
        return generations, [done for _, (_, done) in sorted(self.tables.rows["evaluation"].items()) if done]

    def fitness_of(self, kind: Kind, work: Sequence[Work]) -> dict[bytes, float]:
        self.recalls.count_again(work)
        return self.results.fitness_of(kind, [each.digest for each in work])

    def pending_evaluations(self) -> list[Evaluation]:
        return [evaluation for _, (evaluation, done) in sorted(self.tables.rows["evaluation"].items()) if done is None]

    def finalists(self, count: int) -> list[Finalist]:
        first: dict[bytes, Finalist] = {}
        for generation, (each, done) in sorted(self.tables.rows["evaluation"].items()):
            if done is not None:
                first.setdefault(each.vector, Finalist(generation, each.vector, done.episodes, done.mean))
        return sorted(first.values(), key=lambda each: (-each.mean, each.generation))[:count]

    def evaluated_vector(self, generation: int) -> bytes:
        vector: bytes = self.tables.rows["evaluation"][generation][0].vector
        return vector


def _asked(vectors: tuple[bytes, ...]) -> dict[str, Any]:
    """Columns of a population none of which was drawn anew."""
    return {"vectors": vectors, "first": vectors, "redrawn": ()}


def _kind_of(job: Job) -> str:
    """The kind of a job; of one that chooses or confirms the report, its own."""
    return "confirm" if job.kind == "evaluate" and job.episode >= CHOOSING_OFFSET else job.kind


def _is_behind(job: Job, number: int) -> bool:
    """Whether a job follows from the fitness of this generation."""
    return job.generation > number or (job.generation == number and job.kind != "score")


def _apply(rows: dict[Any, Any], key: Any, row: Any) -> None:
    if row is None:
        rows.pop(key, None)
    else:
        rows[key] = row


def _key_text(key: Any) -> str:
    return key.hex()[:12] if isinstance(key, bytes) else str(key)
