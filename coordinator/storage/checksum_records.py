"""The checksums in a journal, which are written with the commit that makes their rows final."""

from dreamfleet.common.runs.journal import checksums
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint
from dreamfleet.coordinator.storage.journal_connection import JournalConnection


class ChecksumRecords:
    """Writes the checksums of closed generations, finished evaluations and facts, once workers have their next jobs."""

    def __init__(self, journal: JournalConnection) -> None:
        self._journal = journal
        self.closed: list[int] = []  # generations since the last commit
        self.finished: list[int] = []  # evaluations, by generation
        self.is_unsealed = False  # a row has lost its checksum since the last commit

    def write(self) -> None:
        """Write the checksums of what is final since the last commit."""
        journal = self._journal
        for number in self.closed:
            parts = checksums.generation_parts(journal.read, number)
            self._write_row(f"{checksums.GENERATION_ROW} AND number = ?", "generation", "number", number, parts)
        for number in self.finished:
            parts = checksums.evaluation_parts(journal.read, number)
            query = f"{checksums.EVALUATION_ROW} WHERE generation = ?"
            self._write_row(query, "evaluation", "generation", number, parts)
        if self.closed or self.finished or self.is_unsealed:
            journal.set_fact(checksums.SEALED, checksums.sealed_text(journal.read))
        self.closed, self.finished, self.is_unsealed = [], [], False
        if journal.has_changed_facts:
            facts = journal.read("SELECT key, value FROM run")
            journal.set_fact(checksums.RECORD, checksums.record_checksum(facts))
            journal.has_changed_facts = False

    def _write_row(self, query: str, table: str, key: str, number: int, parts: bytes) -> None:
        row = self._journal.read_row(query, number)
        if row is not None:  # else it was opened again meanwhile
            found = checksums.row_checksum(row, parts)
            self._journal.write(f"UPDATE {table} SET checksum = ? WHERE {key} = ?", found, number)  # noqa: S608

    def write_state(self, generation: int, state: Checkpoint | bytes) -> None:
        """Write the strategy's state before a generation was asked for; the journal packs it when it writes."""
        query = "INSERT INTO strategy (generation, state, checksum) VALUES (?1, ?2, state_checksum(?1, ?2))"
        self._journal.write(query, generation, state)
