"""The connection of a journal's only writer: writes wait in memory until a commit, which a full disk only delays."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from dreamfleet.common.errors import JournalError, NotWritableNowError
from dreamfleet.common.files.atomic_write import fsync_path
from dreamfleet.common.runs.journal import schema
from dreamfleet.common.runs.journal.checksums import state_checksum
from dreamfleet.coordinator.storage.journal_file import (
    check_database,
    copy_database,
    file_stamp,
    journal_errors,
    sqlite_side_files,
)

# Of the write-ahead log, before it is folded into the journal. Commits add to the same last pages: the more of them a
# fold has, the fewer pages it writes.
LOG_PAGES = 4000


class JournalConnection:
    """An open journal. Writes wait in memory, in order, until `commit` or the next read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stamp: tuple[int, int] | None = None  # of the file, as the last commit left it
        self._log_size = 0  # of the write-ahead log, as the last commit left it
        self._is_log_cut = False
        self._committed: int | None = None  # the latest generation on disk
        self.opened: int | None = None  # the latest generation
        self.has_changed_facts = False  # since their checksum was written
        self._writes: list[tuple[str, list[tuple[Any, ...]]]] = []  # a statement, and a row for each time it runs
        self._uncommitted: list[tuple[str, list[tuple[Any, ...]]]] = []  # those that ran since the last commit
        with journal_errors(path):
            self._connection = sqlite3.connect(path, timeout=5)
            try:
                self._connection.create_function("state_checksum", 2, state_checksum, deterministic=True)
                schema.check_schema(self._connection, path)
                self._connection.execute("PRAGMA journal_mode = WAL")
                self._connection.execute("PRAGMA synchronous = FULL")
                self._connection.execute(f"PRAGMA wal_autocheckpoint = {LOG_PAGES}")
                self._connection.execute("PRAGMA cache_spill = OFF")  # only a commit can find the disk full
            except BaseException:
                self._connection.close()
                raise

    def close(self) -> None:
        """Fold the write-ahead log into the journal and release it.

        Where readers have it open, the log stays beside it, empty; the last of them removes it.
        """
        with suppress(sqlite3.Error):
            self._connection.rollback()
            self._connection.execute("PRAGMA busy_timeout = 0")  # readers do not wait for each other
            self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        self._connection.close()

    @property
    def is_overwritten(self) -> bool:
        """Whether somebody else wrote into the journal's own file, and what it holds now is not what was committed.

        Only a commit of this connection writes there, so the file is looked into where its time or size is another's.
        """
        if self._stamp in (None, file_stamp(self.path)):
            return False
        self._stamp = file_stamp(self.path)
        return self._check_files() != ("ok", self.opened)

    @property
    def is_log_cut(self) -> bool:
        """Whether somebody truncated the write-ahead log and lost commits; this connection only lets it grow.

        Another program's checkpoint may empty the log, once the journal's own file holds everything.
        """
        size = self._current_log_size()
        if not self._is_log_cut and size is not None and size < self._log_size:
            self._is_log_cut = size > 0 or self._check_files() != ("ok", self._committed)
            self._log_size = size
        return self._is_log_cut

    @property
    def is_whole(self) -> bool:
        """Whether the files on disk can be read, all of them."""
        return self._check_files()[0] == "ok"

    def _check_files(self) -> tuple[str, int | None]:
        """What `check_database` finds in the files, and not in what this connection remembers."""
        where = f"{self.path.absolute().as_uri()}?mode=ro"
        try:
            with closing(sqlite3.connect(where, uri=True)) as reader:
                return check_database(reader)
        except sqlite3.Error as error:
            return str(error), None

    def _current_log_size(self) -> int | None:
        found = file_stamp(sqlite_side_files(self.path)[0])
        return None if found is None else found[1]

    def save_copy(self, path: Path) -> None:
        """Write all that is committed into a new file, checked, whole or not at all."""
        with suppress(sqlite3.Error):
            self._connection.rollback()  # SQLite copies no database inside a transaction
        aside = path.with_name(f".{path.name}.part")
        try:
            with journal_errors(path):
                found = copy_database(self._connection, aside)
            if found != ("ok", self._committed):
                raise JournalError("the data of the open connection is not whole: restore the folder from a copy")
            fsync_path(aside)
            aside.replace(path)
            fsync_path(path.parent)
        finally:
            for left in (aside, *sqlite_side_files(aside)):
                left.unlink(missing_ok=True)

    def commit(self) -> None:
        """Make everything written so far durable; after `NotWritableNowError` it may be called again.

        `JournalError` if the write-ahead log was truncated: a commit would leave a hole in it, which reads as zeros.
        """
        if self.is_log_cut:
            raise JournalError(f"the write-ahead log of {self.path} was truncated while it was served")
        own = self._stamp in (None, file_stamp(self.path))
        self.flush()
        with self._kept_writes():
            self._connection.commit()
        self._uncommitted = []
        self._committed, self._log_size = self.opened, self._current_log_size() or 0
        if own:  # else somebody wrote there since the last commit, which `is_overwritten` looks into
            self._stamp = file_stamp(self.path)

    def flush(self) -> None:
        """Send everything written so far to the database; after `NotWritableNowError` it may be called again."""
        with self._kept_writes():
            writes, self._writes = self._writes, []
            self._uncommitted += writes
            for statement, rows in writes:
                self._connection.executemany(statement, rows)

    def forget_writes(self) -> None:
        """Drop everything written since the last commit."""
        self._drop_writes()
        self.opened = self._committed

    @contextmanager
    def as_committed(self) -> Iterator[None]:
        """Read what is durable, without what waits to be written. A locked journal does not hold it up."""
        waiting = [*self._uncommitted, *self._writes]
        try:
            self._drop_writes()
            yield
        finally:
            self._drop_writes()
            self._writes = waiting

    def _drop_writes(self) -> None:
        with suppress(sqlite3.Error):
            self._connection.rollback()
        self._writes, self._uncommitted = [], []

    def take_lock(self) -> None:
        """Flush in a transaction: until its commit no other program can lock the journal. Errors as of `flush`."""
        self.flush()
        if not self._connection.in_transaction:
            with journal_errors(self.path):
                self._connection.execute("BEGIN IMMEDIATE")

    @contextmanager
    def _kept_writes(self) -> Iterator[None]:
        """Raise errors as `journal_errors` does; keep all writes since the last commit for another try."""
        try:
            with journal_errors(self.path):
                yield
        except NotWritableNowError:
            with suppress(sqlite3.Error):
                self._connection.rollback()
            self._writes, self._uncommitted = [*self._uncommitted, *self._writes], []
            raise

    def set_busy_timeout(self, seconds: float) -> None:
        """How long a write waits for another program's lock."""
        self._connection.execute(f"PRAGMA busy_timeout = {int(1000 * seconds)}")

    @property
    def has_writes(self) -> bool:
        """Whether something waits for the next commit."""
        return bool(self._writes) or self._connection.in_transaction

    def fact(self, key: str) -> str | None:
        """One of the run's facts, such as `uid` or `fingerprint`."""
        row = self.read_row("SELECT value FROM run WHERE key = ?", key)
        return None if row is None else str(row[0])

    def set_fact(self, key: str, value: str) -> None:
        """Write one of the run's facts."""
        self.write("INSERT OR REPLACE INTO run (key, value) VALUES (?, ?)", key, value)
        self.has_changed_facts = True

    def drop_fact(self, key: str) -> None:
        """Forget one of the run's facts."""
        self.write("DELETE FROM run WHERE key = ?", key)
        self.has_changed_facts = True

    def write(self, statement: str, *values: Any) -> None:
        """Run a statement before the next read or commit."""
        self.write_all(statement, [values])

    def insert(self, table: str, **values: Any) -> None:
        """Add a row with these values, by column, before the next read or commit."""
        marks = ", ".join("?" * len(values))
        self.write(f"INSERT INTO {table} ({', '.join(values)}) VALUES ({marks})", *values.values())  # noqa: S608

    def write_all(self, statement: str, rows: list[tuple[Any, ...]]) -> None:
        """Run a statement once for each row of values, before the next read or commit."""
        if self._writes and self._writes[-1][0] == statement:
            self._writes[-1][1].extend(rows)
        else:
            self._writes.append((statement, rows))

    def read(self, query: str, *values: Any) -> list[Any]:
        """All rows of a query: a damaged page raises its error here, not in the code that iterates over the rows."""
        self.flush()
        return self.read_written(query, *values)

    def read_written(self, query: str, *values: Any) -> list[Any]:
        """All rows of a query, without what waits to be written: a locked journal does not hold it up."""
        with journal_errors(self.path):
            return self._connection.execute(query, values).fetchall()

    def read_row(self, query: str, *values: Any) -> Any:
        """The first row of a query; `None` if there is none."""
        return next(iter(self.read(query, *values)), None)
