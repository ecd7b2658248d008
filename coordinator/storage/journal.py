"""The only writer of a run's journal: a result is on disk before the worker gets its verdict. Pages: unattended.md."""

from __future__ import annotations

import json
import secrets
import shutil
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import groupby
from math import nan
from operator import itemgetter
from pathlib import Path
from time import time

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.errors import DamagedJournalError, JournalError
from dreamfleet.common.files.atomic_write import atomic_write, fsync_path, reporting_unwritable_folder
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.messages import Job, Kind
from dreamfleet.common.protocol.result_bounds import to_finite
from dreamfleet.common.runs.journal import schema
from dreamfleet.common.runs.journal.checksums import RECORD, REST, record_checksum, rest_checksum, state_checksum
from dreamfleet.common.runs.records import RunSettings, StoredEvaluation, StoredGeneration
from dreamfleet.common.runs.run_folder import ENDED_AT, RunFolder
from dreamfleet.common.runs.run_paths import BUNDLE, JOURNAL, run_command
from dreamfleet.coordinator.jobs.confirmation import Finalist
from dreamfleet.coordinator.jobs.evaluation import Evaluation
from dreamfleet.coordinator.jobs.rollout_collection import RolloutCollection
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint
from dreamfleet.coordinator.storage.batch_records import BatchRecords
from dreamfleet.coordinator.storage.checksum_records import ChecksumRecords
from dreamfleet.coordinator.storage.journal_connection import JournalConnection
from dreamfleet.coordinator.storage.journal_file import journal_errors, sqlite_side_files
from dreamfleet.coordinator.storage.recall_records import RecallRecords
from dreamfleet.coordinator.storage.result_records import ResultRecords
from dreamfleet.coordinator.storage.verification_records import VerificationRecords

sqlite3.register_adapter(Checkpoint, Checkpoint.packed)  # when it is written, not while workers wait

MAX_EVENTS = 10_000  # R26: unknown senders and failing hosts cause some
LEAVES = "leaves"  # what the last event of an incarnation is that was not killed
RECALLED = "recalled"  # of one that left to the next what was taken back
# Seconds for which a write waits for another program's lock. A run tries again, so that it answers meanwhile.
SERVING_TIMEOUT, LEAVING_TIMEOUT = 0.5, 5.0
FINGERPRINT, HOST_CLASS = "fingerprint", "host_class"  # the facts' names


@dataclass(frozen=True)
class StoredOpenGeneration:
    """A generation whose fitness is still incomplete: the state before `ask`, its seeds and its population."""

    number: int
    state: bytes
    seeds: tuple[int, ...]
    vectors: tuple[bytes, ...]  # float32, as they travel; the latest ones of candidates that were drawn anew
    redrawn: tuple[tuple[int, ...], ...] = ()  # candidates, by round
    seconds: float = 0.0  # for which it could be scored so far


class Journal(JournalConnection):
    """The journal of one incarnation: facts, generations, evaluations and events here, the rest in its parts."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.checksums = ChecksumRecords(self)
        self.results = ResultRecords(self)
        self.batches = BatchRecords(self)
        self.verification = VerificationRecords(self, self.results)
        self.recalls = RecallRecords(self, self.checksums, self.results)
        self._incarnation = 0

    def commit(self) -> None:
        """Make everything durable with its checksums; errors as of `JournalConnection.commit`."""
        if not self.is_log_cut:
            self.checksums.write()
        super().commit()

    @classmethod
    def create(
        cls, folder: Path, settings: RunSettings, bundle: Path | None, facts: Mapping[str, str] | None = None
    ) -> Journal:
        """A new run in `folder`, which holds its own copy of the bundle, if any; whole or not at all.

        `facts` are what else the run must never be without: where it begins, and how it is served.
        """
        cls.check_absent(folder)
        path = folder / JOURNAL
        aside = path.with_suffix(".new")
        own = {"uid": secrets.token_hex(16), "settings": settings.to_json(), "created": _now(), **(facts or {})}
        own[RECORD] = record_checksum(own.items())
        with reporting_unwritable_folder(folder, "choose another --runs-dir", JournalError):
            # What a journal that was removed left beside it would be taken for this one's, and damage it.
            for left in (aside, *sqlite_side_files(aside), *sqlite_side_files(path)):
                left.unlink(missing_ok=True)
            if bundle is not None:
                with bundle.open("rb") as source, atomic_write(folder / BUNDLE) as copy:
                    shutil.copyfileobj(source, copy)
            aside.touch(mode=0o600)  # its log has the same mode
            with journal_errors(path), closing(sqlite3.connect(aside)) as connection:
                schema.create_tables(connection)
                connection.executemany("INSERT INTO run (key, value) VALUES (?, ?)", own.items())
                connection.commit()
            aside.replace(path)
            fsync_path(folder)
        return cls(path)

    @classmethod
    def open_verified(cls, folder: Path) -> Journal:
        """The journal of a run that this process locked, once it is verified; a damaged one is not written to."""
        cls.verify(folder)
        return cls(folder / JOURNAL)

    @staticmethod
    def verify(folder: Path) -> None:
        """Compare all that is committed with its checksums; `DamagedJournalError` if anything differs."""
        with RunFolder(folder) as stored:
            stored.verify()

    @staticmethod
    def check_absent(folder: Path) -> None:
        """`JournalError` if `folder` holds a run already."""
        if (folder / JOURNAL).exists():
            raise JournalError(
                f"run {folder.name} exists: choose another --run, or continue it with --resume; "
                f"`{run_command(folder, 'runs', 'delete')}` removes it"
            )

    def check_incarnation(self) -> None:
        """`JournalError` if another coordinator has begun in this journal: a lock held neither of them back."""
        rows = self.read_written("SELECT value FROM run WHERE key = 'incarnation'")
        found = int(rows[0][0]) if rows else 0
        if found != self._incarnation:
            raise JournalError(
                f"another coordinator serves {self.path} too (incarnation {found}, this one is {self._incarnation}): "
                "this one leaves; what it committed is whole, and the other one continues it"
            )

    def fingerprint(self) -> str | None:
        """The fingerprint of the host of the first accepted result; `None` before it."""
        scored = self.read_row("SELECT 1 FROM result LIMIT 1") is not None
        return self.fact(FINGERPRINT) if scored else None

    def host_class(self) -> str | None:
        """The class of the host of the first accepted result; `None` before it."""
        return None if self.fingerprint() is None else self.fact(HOST_CLASS)

    def end(self, why: str) -> None:
        """The run ended, now; one that had ended before, with nothing left to do, keeps its time."""
        if self.fact("ended") is None:
            self.set_fact(ENDED_AT, _now())
        self.set_fact("ended", why)

    def begin_incarnation(self) -> int:
        """Number of this incarnation of the coordinator, from 1; to be committed before anything is published."""
        number = int(self.fact("incarnation") or 0) + 1
        last = self.read_row("SELECT what FROM event ORDER BY number DESC LIMIT 1")
        killed = (
            "; the last one was killed, crashed or could not write"
            if last not in (None, (LEAVES,), (RECALLED,))
            else ""
        )
        self._incarnation = number
        self.set_fact("incarnation", str(number))
        self.drop_fact(REST)
        self.add_event(f"incarnation {number} begins{killed}")
        self.opened = self._committed = self.read_row("SELECT max(number) FROM generation")[0]
        self.set_busy_timeout(SERVING_TIMEOUT)
        return number

    def end_incarnation(self) -> None:
        """Write that the coordinator leaves by itself."""
        self.set_busy_timeout(LEAVING_TIMEOUT)
        self.add_event("the coordinator leaves", LEAVES)
        if self.fact("ended") is not None:
            self.set_fact(REST, rest_checksum(self.read))  # nothing comes any more

    def open_generation(
        self, number: int, state: Checkpoint, sigma: float, seeds: Sequence[int], vectors: Sequence[bytes]
    ) -> None:
        """Write a population, and the strategy's state before `ask`; the two latest states stay."""
        self.insert("generation", number=number, seeds=json.dumps(list(seeds)), opened=time(), sigma=sigma)
        rows = [(number, index, vector) for index, vector in enumerate(vectors)]
        self.write_all("INSERT INTO candidate (generation, number, vector) VALUES (?, ?, ?)", rows)
        self.checksums.write_state(number, state)
        self.write("DELETE FROM strategy WHERE generation < ?", number - 1)
        self.opened = number

    def close_generation(
        self, closed: StoredGeneration, fitness: NDArray[np.float64], measures: NDArray[np.float64] | None = None
    ) -> None:
        """Write fitness and measures, which update the strategy, and the generation's statistics, if it has any."""
        is_scored = bool(np.isfinite(fitness).any())
        statistics = (closed.mean, closed.std, closed.best, closed.worst) if is_scored else (None,) * 4
        self.write_all(
            "UPDATE candidate SET fitness = ? WHERE generation = ? AND number = ?",
            [(float(value), closed.number, index) for index, value in enumerate(fitness)],  # SQLite has NULL for NaN
        )
        if measures is not None:
            self.write_all(
                "UPDATE candidate SET measures = ? WHERE generation = ? AND number = ?",
                [
                    (json.dumps(row.tolist()), closed.number, index)
                    for index, row in enumerate(measures)
                    if np.isfinite(row).all()
                ],
            )
        self.write(
            "UPDATE generation SET closed = ?, mean = ?, std = ?, best = ?, worst = ?, steps = ?, seconds = ?, "
            "failed = ? WHERE number = ?",
            time(), *statistics, closed.steps, closed.seconds, closed.failed, closed.number,
        )  # fmt: skip
        self.checksums.closed.append(closed.number)

    def set_seconds(self, generation: int, seconds: float) -> None:
        """Write for how long the open generation could be scored so far."""
        self.write("UPDATE generation SET seconds = ? WHERE number = ?", seconds, generation)

    def set_seeds(self, generation: int, seeds: Sequence[int]) -> None:
        """Write other seeds of the open generation."""
        self.write("UPDATE generation SET seeds = ? WHERE number = ?", json.dumps(list(seeds)), generation)

    def redraw(self, generation: int, indices: Sequence[int], vectors: Sequence[bytes]) -> None:
        """Write the new vectors of candidates that failed; the old ones are kept by round."""
        (rounds,) = self.read_row("SELECT count(DISTINCT round) FROM redraw WHERE generation = ?", generation)
        self.write_all(
            "INSERT INTO redraw (generation, round, candidate, vector) "
            "SELECT generation, ?, number, vector FROM candidate WHERE generation = ? AND number = ?",
            [(rounds, generation, index) for index in indices],
        )
        self.write_all(
            "UPDATE candidate SET vector = ? WHERE generation = ? AND number = ?",
            [(vector, generation, index) for vector, index in zip(vectors, indices, strict=True)],
        )

    def add_failure(self, job: Job, error: Failure, workers: Sequence[str], attempts: int) -> None:
        """Write that a job's episode failed for good."""
        self.insert(
            "failure", digest=job.digest, kind=job.kind, generation=job.generation, candidate=job.candidate,
            episode=job.episode, seed=job.seeds[0], error=error.text, cause=error.cause, fault=error.kind,
            workers=",".join(workers), attempts=attempts, incarnation=self._incarnation, happened=time(),
        )  # fmt: skip

    def add_event(self, text: str, what: str = "", worker: str = "") -> None:
        """Write what happened to the run, for people, and to which worker; the last `MAX_EVENTS` are kept."""
        about = {"text": text, "what": what, "worker": worker}
        self.insert("event", happened=time(), incarnation=self._incarnation, **about)
        self.write("DELETE FROM event WHERE number <= (SELECT max(number) FROM event) - ?", MAX_EVENTS)

    def drop_failures(self, generation: int) -> None:
        """Forget the failures of a generation's candidates, so that they are scored again."""
        self.write("DELETE FROM failure WHERE kind = 'score' AND generation = ?", generation)

    def schedule_evaluation(self, evaluation: Evaluation) -> None:
        """Write that the mean of a generation is to be evaluated."""
        self.insert("evaluation", **vars(evaluation))

    def drop_failures_of(self, digests: Sequence[bytes]) -> None:
        """Forget the failures of these jobs, so that they are scored again."""
        self.write_all("DELETE FROM failure WHERE digest = ?", [(digest,) for digest in digests])

    def finish_evaluation(self, generation: int, found: StoredEvaluation | None, failed: int) -> None:
        """Write what an evaluation gave: `None` if each of its episodes `failed`."""
        mean, std = (None, None) if found is None else (found.mean, found.std)
        query = "UPDATE evaluation SET mean = ?, std = ?, failed = ? WHERE generation = ?"
        self.write(query, mean, std, failed, generation)
        self.checksums.finished.append(generation)

    def schedule_collection(self, collection: RolloutCollection) -> None:
        """Write that drives of a generation's mean are to be kept."""
        self.insert("collection", **vars(collection))

    def scheduled_collections(self) -> list[RolloutCollection]:
        """Everything that was scheduled to be kept, oldest first."""
        query = "SELECT generation, vector, episodes FROM collection ORDER BY generation"
        return [RolloutCollection(*row) for row in self.read(query)]

    def last_generation(self) -> StoredOpenGeneration | None:
        """The generation that was open when the last incarnation ended; `None` in a new run."""
        (number,) = self.read_row("SELECT max(number) FROM generation")
        return None if number is None else self.generation(number)

    def generation(self, number: int) -> StoredOpenGeneration | None:
        """One of the last two generations, with the population that was sampled; `None` if its state is deleted."""
        row = self.read_row(
            "SELECT state, seeds, generation.seconds, strategy.checksum FROM generation JOIN strategy "
            "ON number = strategy.generation WHERE number = ?",
            number,
        )
        if row is None:
            return None
        if row[-1] not in (None, state_checksum(number, row[0])):
            raise DamagedJournalError(
                f"{self.path} is damaged: the optimiser's state differs from its checksum; restore it from a copy"
            )
        state, seeds, seconds, _ = row
        vectors, redrawn = self.vectors_of(number), self.redraws_of(number)
        try:
            if not all(0 <= each < len(vectors) for candidates in redrawn for each in candidates):
                raise ValueError(f"generation {number} lacks a candidate that was redrawn")
            return StoredOpenGeneration(
                number, state, tuple(json.loads(seeds)), vectors, tuple(map(tuple, redrawn)), to_finite(seconds or 0.0)
            )
        except (ValueError, TypeError) as error:
            raise DamagedJournalError(f"{self.path} is damaged: {error}; restore it from a copy") from error

    def is_closed(self, number: int) -> bool:
        """Whether a generation has its fitness."""
        return self.read_row("SELECT closed FROM generation WHERE number = ?", number) not in (None, (None,))

    def vectors_of(self, number: int) -> tuple[bytes, ...]:
        """The population of a generation, the latest vectors of candidates that were drawn anew."""
        rows = self.read("SELECT vector FROM candidate WHERE generation = ? ORDER BY number", number)
        return tuple(vector for (vector,) in rows)

    def redraws_of(self, number: int) -> list[list[int]]:
        """The candidates of a generation that were drawn anew, by round."""
        rows = self.read("SELECT round, candidate FROM redraw WHERE generation = ? ORDER BY round, candidate", number)
        return [[candidate for _, candidate in redrawn] for _, redrawn in groupby(rows, key=itemgetter(0))]

    def seeds_of(self, number: int) -> list[int]:
        """The seeds of a generation."""
        (seeds,) = self.read_row("SELECT seeds FROM generation WHERE number = ?", number)
        return list(json.loads(seeds))

    def scores_of(self, number: int, axes: int) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
        """Fitness of a closed generation, as the strategy took it, and measures if it has `axes` of them."""
        query = "SELECT fitness, measures FROM candidate WHERE generation = ? ORDER BY number"
        rows = self.read(query, number)
        fitness = np.array([nan if each is None else each for each, _ in rows], dtype=np.float64)
        if not axes:
            return fitness, None
        return fitness, np.array([[nan] * axes if each is None else json.loads(each) for _, each in rows])

    def read_closed(self) -> tuple[list[StoredGeneration], list[StoredEvaluation]]:
        """Every closed generation and finished evaluation, oldest first."""
        with RunFolder(self.path.parent) as folder:
            return folder.history(), folder.evaluations()

    def fitness_of(self, kind: Kind, work: Sequence[ScoringJob]) -> dict[bytes, float]:
        """As `ResultRecords.fitness_of`; results of dropped generations that these jobs want count again."""
        self.recalls.count_again(work)
        return self.results.fitness_of(kind, [each.digest for each in work])

    def pending_evaluations(self) -> list[Evaluation]:
        """Evaluations that were scheduled and not finished, oldest first."""
        query = (
            "SELECT generation, vector, episodes FROM evaluation WHERE mean IS NULL AND failed < episodes "
            "ORDER BY generation"
        )
        return [Evaluation(*row) for row in self.read(query)]

    def finalists(self, count: int) -> list[Finalist]:
        """The best evaluated means, best first; of generations with one mean and of equals the earliest."""
        query = (
            "SELECT min(generation), vector, episodes - failed, mean, failed FROM evaluation WHERE mean IS NOT NULL "
            "GROUP BY vector ORDER BY failed, mean DESC, 1 LIMIT ?"
        )
        rows = self.read(query, count)
        return [Finalist(generation, vector, episodes, to_finite(mean), failed)
                for generation, vector, episodes, mean, failed in rows]  # fmt: skip

    def evaluated_vector(self, generation: int) -> bytes:
        """The mean after a generation that was scheduled to be evaluated."""
        (vector,) = self.read_row("SELECT vector FROM evaluation WHERE generation = ?", generation)
        return bytes(vector)


def _now() -> str:
    """ISO 8601, UTC."""
    return datetime.now(UTC).isoformat(timespec="seconds")
