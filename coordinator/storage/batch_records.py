"""The batches in a journal: what others submitted to a run without a search. Pages: ask-tell.md, protocol.md."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import time

from dreamfleet.common.errors import DamagedJournalError
from dreamfleet.common.protocol.batches import BatchLine, BatchState
from dreamfleet.common.protocol.result_bounds import to_finite
from dreamfleet.coordinator.storage.journal_connection import JournalConnection

OPEN = "('running', 'waiting')"  # states, as the index has them


@dataclass(frozen=True)
class StoredBatch:
    """A submitted batch; its vectors are read when its generation opens."""

    number: int  # from 0, in order of submission
    id: str
    content: bytes  # SHA-256 of what is to be scored
    seeds: tuple[int, ...]
    population: int
    generation: int | None  # that scores it; `None` while it waits
    state: BatchState
    errors: Mapping[int, str]  # why a candidate has no fitness, once the batch is complete


class BatchRecords:
    """Reads and writes a journal's batches."""

    def __init__(self, journal: JournalConnection) -> None:
        self._journal = journal

    def add(self, batch_id: str, content: bytes, seeds: Sequence[int], population: int, vectors: bytes) -> None:
        """Write a batch that waits; `vectors` are float32, row by row."""
        self._journal.insert(
            "batch", number=self.count(), id=batch_id, content=content, seeds=json.dumps(list(seeds)),
            population=population, vectors=vectors, submitted=time(), state="waiting",
        )  # fmt: skip

    def begin(self, batch_id: str, generation: int) -> None:
        """Write that a generation scores the batch; its vectors are that generation's candidates."""
        self._journal.write(
            "UPDATE batch SET state = 'running', generation = ?, vectors = NULL WHERE id = ?", generation, batch_id
        )

    def cancel(self, batch_id: str) -> None:
        """Write that nobody wants the batch any more."""
        self._journal.write("UPDATE batch SET state = 'cancelled', vectors = NULL WHERE id = ?", batch_id)

    def finish(self, batch_id: str, errors: Mapping[int, str]) -> None:
        """Write that the batch's generation is closed; a cancelled one stays cancelled."""
        self._journal.write(
            "UPDATE batch SET errors = ?, state = CASE state WHEN 'running' THEN 'complete' ELSE state END "
            "WHERE id = ?",
            json.dumps(errors),
            batch_id,
        )

    def count(self) -> int:
        """How many batches were ever submitted."""
        (count,) = self._journal.read_row("SELECT ifnull(max(number) + 1, 0) FROM batch")
        return int(count)

    def find(self, batch_id: str) -> StoredBatch | None:
        """The batch of this id; `None` if there is none."""
        return self._find("id = ?", batch_id)

    def of(self, generation: int) -> StoredBatch | None:
        """The batch that a generation scores; `None` if there is none."""
        return self._find("generation = ?", generation)

    def next_waiting(self) -> StoredBatch | None:
        """The batch that has waited longest; `None` if none waits."""
        return self._find("state = 'waiting' ORDER BY number LIMIT 1")

    def lines(self, most: int) -> list[BatchLine]:
        """The open batches in their order, then finished ones, the last first; so in openapi.py, batch_client.py."""
        query = "SELECT id, state, population, generation FROM batch WHERE state"
        found = [
            BatchLine(*row)
            for where in (f"IN {OPEN} ORDER BY number", f"NOT IN {OPEN} ORDER BY number DESC")
            for row in self._journal.read(f"{query} {where} LIMIT ?", most)
        ]
        return found[:most]

    def open_count(self) -> int:
        """How many batches wait or are scored."""
        return int(self._journal.read_row(f"SELECT count(*) FROM batch WHERE state IN {OPEN}")[0])  # noqa: S608

    def waiting(self) -> tuple[int, int]:
        """How many batches wait, and the bytes of their vectors."""
        query = "SELECT count(*), ifnull(sum(length(vectors)), 0) FROM batch WHERE state = 'waiting'"
        count, size = self._journal.read_row(query)
        return int(count), int(size)

    def vectors(self, batch: StoredBatch) -> list[bytes]:
        """The vectors of a batch that waits, each as float32 bytes."""
        (data,) = self._journal.read_row("SELECT vectors FROM batch WHERE id = ?", batch.id)
        size, rest = divmod(len(data or b""), batch.population)
        if rest or not size:
            raise DamagedJournalError(
                f"{self._journal.path} is damaged: batch {batch.id} lacks its vectors; restore it from a copy"
            )
        return [bytes(data[start : start + size]) for start in range(0, len(data), size)]

    def fitness_page(self, generation: int, offset: int, limit: int) -> list[float | None]:
        """The fitness of a closed generation's candidates from `offset` on; `None` for those that have none."""
        query = "SELECT fitness FROM candidate WHERE generation = ? AND number >= ? ORDER BY number LIMIT ?"
        rows = self._journal.read(query, generation, offset, limit)
        return [None if fitness is None else to_finite(fitness) for (fitness,) in rows]

    def _find(self, where: str, *values: object) -> StoredBatch | None:
        columns = "number, id, content, seeds, population, generation, state, errors"
        row = self._journal.read_row(f"SELECT {columns} FROM batch WHERE {where}", *values)  # noqa: S608
        if row is None:
            return None
        try:
            number, batch_id, content, seeds, population, generation, state, errors = row
            named = {int(index): str(text) for index, text in json.loads(errors).items()}
            return StoredBatch(
                number, batch_id, content, tuple(json.loads(seeds)), population, generation, state, named
            )
        except (ValueError, TypeError, AttributeError) as error:
            raise DamagedJournalError(f"{self._journal.path} is damaged: {error}; restore it from a copy") from error
