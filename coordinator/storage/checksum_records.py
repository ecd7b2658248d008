"""The checksums in a journal, which are written with the commit that makes their rows final."""

from __future__ import annotations

import sqlite3
from pathlib import Path

from dreamfleet.common.runs.journal import checksums
from dreamfleet.common.runs.journal.checksums import RECORD, REST, SEALED, sealed_text, state_checksum
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint
from dreamfleet.coordinator.storage.journal_connection import JournalConnection


class ChecksumRecords(JournalConnection):
    """Writes the checksums of closed generations, finished evaluations and facts, once workers have their next jobs."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._closed_now: list[int] = []  # generations since the last commit
        self._finished_now: list[int] = []  # evaluations, by generation
        self._is_record_changed = False
        self._is_unsealed = False  # a row has lost its checksum since the last commit

    def _prepare(self, connection: sqlite3.Connection) -> None:
        connection.create_function("state_checksum", 2, state_checksum, deterministic=True)

    def set_fact(self, key: str, value: str) -> None:
        """Write one of the run's facts."""
        super().set_fact(key, value)
        self._is_record_changed = True

    def drop_fact(self, key: str) -> None:
        """Forget one of the run's facts."""
        super().drop_fact(key)
        self._is_record_changed = True

    def commit(self) -> None:
        """Make everything durable with its checksums; errors as of `JournalConnection.commit`."""
        if not self.is_log_cut:
            self._write_checksums()
        super().commit()

    def _write_checksums(self) -> None:
        for number in self._closed_now:
            parts = checksums.generation_parts(self._read, number)
            self._write_checksum(f"{checksums.GENERATION_ROW} AND number = ?", "generation", "number", number, parts)
        for number in self._finished_now:
            parts = checksums.evaluation_parts(self._read, number)
            query = f"{checksums.EVALUATION_ROW} WHERE generation = ?"
            self._write_checksum(query, "evaluation", "generation", number, parts)
        if self._closed_now or self._finished_now or self._is_unsealed:
            self.set_fact(SEALED, sealed_text(self._read))
        self._closed_now, self._finished_now, self._is_unsealed = [], [], False
        if self._is_record_changed:
            found = checksums.record_checksum(self._read("SELECT key, value FROM run"))
            super().set_fact(RECORD, found)
            self._is_record_changed = False

    def _write_checksum(self, query: str, table: str, key: str, number: int, parts: bytes) -> None:
        row = self._read_row(query, number)
        if row is not None:  # else it was opened again meanwhile
            found = checksums.row_checksum(row, parts)
            self._write(f"UPDATE {table} SET checksum = ? WHERE {key} = ?", found, number)  # noqa: S608

    def _write_state(self, generation: int, state: Checkpoint | bytes) -> None:
        """Write the strategy's state before a generation was asked for; the journal packs it when it writes."""
        query = "INSERT INTO strategy (generation, state, checksum) VALUES (?1, ?2, state_checksum(?1, ?2))"
        self._write(query, generation, state)

    def set_rest_checksum(self) -> None:
        """Write the checksum of what belongs to no generation: nothing comes any more."""
        self.set_fact(REST, checksums.rest_checksum(self._read))
