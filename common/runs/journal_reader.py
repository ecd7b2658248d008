"""The read-only connection to a run's journal, and its larger queries."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from types import NoneType
from typing import Any

from dreamfleet.common.errors import JournalError
from dreamfleet.common.files.file_system import lock_problem
from dreamfleet.common.files.regular_files import check_regular
from dreamfleet.common.printable import one_line
from dreamfleet.common.runs import schema
from dreamfleet.common.runs.seeds import CHOOSING_OFFSET
from dreamfleet.common.runs.stages import BegunStage

_TYPES: dict[str, tuple[type, ...]] = {
    "i": (int,), "f": (int, float), "F": (int, float, NoneType), "s": (str,), "b": (bytes,),
}  # fmt: skip
CANDIDATES_QUERY = (
    "SELECT candidate.generation, number, candidate.fitness, count(digest), total(steps), total(seconds) "
    "FROM candidate LEFT JOIN result ON kind = 'score' AND candidate = number "
    "AND result.generation = candidate.generation GROUP BY 1, 2 ORDER BY 1, 2"
)


class JournalReader:
    """A read-only connection to the journal at `path`; every failure is a `JournalError`."""

    def __init__(self, path: Path) -> None:
        self._run, self._path, self._closed = path.parent.name, path, False
        self._connection, self.version = _connect_read_only(path)

    def close(self) -> None:
        """Release the journal."""
        self._closed = True
        self._connection.close()

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Queries inside see one state of the journal, whatever a coordinator writes meanwhile; may be nested."""
        if not self._closed and self._connection.in_transaction:
            yield
            return
        self._fetch("BEGIN")  # deferred: the first query fixes the state
        try:
            yield
        finally:
            with suppress(sqlite3.Error):
                self._connection.rollback()

    def rows(self, kinds: str, query: str, *values: Any) -> list[Any]:
        """All rows of a query, checked for their column types.

        `kinds` has a letter for each column: i integer, f number, F number or NULL, s text, b bytes. A damaged page, or
        another program, may have left other types.
        """
        found, types = self._fetch(query, *values), [_TYPES[each] for each in kinds]
        if not all(all(map(isinstance, row, types)) for row in found):
            raise self.damage_error("a row holds values of another type")
        return found

    def row(self, query: str, *values: Any) -> Any:
        """The first row of a query, unchecked; `None` if there is none."""
        found = self._fetch(query, *values)
        return found[0] if found else None

    def fact(self, key: str) -> str | None:
        """One of the run's facts; `None` if it has no such fact."""
        row = self.row("SELECT value FROM run WHERE key = ?", key)
        return None if row is None else str(row[0])

    def damage_error(self, what: str) -> JournalError:
        """The error for a damaged journal."""
        return JournalError(f"the journal of run {self._run} is damaged: {what}; restore it from a copy")

    def _fetch(self, query: str, *values: Any) -> list[Any]:
        if self._closed:
            raise JournalError(f"run {self._run} was closed here: open it again")
        try:
            return self._connection.execute(query, values).fetchall()
        except (sqlite3.Error, OverflowError, UnicodeError) as error:
            if _is_locked(error):
                raise JournalError(
                    f"the journal of run {self._run} cannot be read: {_describe_with_remedy(error, self._path)}"
                ) from error
            raise self.damage_error(one_line(str(error))) from error


def class_counts_query(class_column: str = "host_class") -> str:
    """Count results by host class, which may be empty, and fingerprint."""
    return f"SELECT {class_column}, fingerprint, count(*) FROM result GROUP BY 1, 2"  # noqa: S608


def results_query(class_column: str) -> str:
    """The results of one kind, generation and candidate, by episode."""
    return (
        "SELECT kind, generation, candidate, episode, seed, fitness, steps, seconds, worker, fingerprint, "  # noqa: S608
        f"{class_column}, hex(digest) FROM result WHERE kind = ? AND generation = ? AND candidate = ? ORDER BY episode"
    )


def efforts_query(begun: Sequence[BegunStage]) -> str:
    """Sum steps and time by kind, generation, and whether results confirm the report or were driven in reality.

    Columns: kind, generation, confirming, driven, steps, microseconds. Sums are floats: old journals hold huge numbers.
    """
    whens = " ".join(f"WHEN generation >= {each.since} THEN {each.stage.driven_episodes}" for each in reversed(begun))
    return (
        f"SELECT kind, generation, kind = 'evaluate' AND episode >= {CHOOSING_OFFSET}, "  # noqa: S608
        f"kind = 'score' AND episode < CASE {whens} ELSE 0 END, total(steps), "
        "total(CAST(seconds * 1e6 AS INTEGER)) FROM result GROUP BY 1, 2, 3, 4 ORDER BY 2, 3, 1, 4"
    )


WORK_QUERY = (
    f"SELECT worker, generation, kind, kind = 'evaluate' AND episode >= {CHOOSING_OFFSET}, count(*), total(steps), "  # noqa: S608
    "total(seconds) FROM result GROUP BY 1, 2, 3, 4"
)


def _connect_read_only(path: Path, *, rolled_back: bool = False) -> tuple[sqlite3.Connection, int]:
    """An open journal and its schema version."""
    # In a read-only folder SQLite cannot create the shared-memory file. It needs none where no write-ahead log is left.
    immutable = "" if os.access(path.parent, os.W_OK) or _has_log(path) else "&immutable=1"
    try:
        check_regular(path)  # SQLite would block on a pipe
        connection = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro{immutable}", uri=True)
    except (sqlite3.Error, OSError) as error:
        raise JournalError(f"{path} cannot be read: {error}") from error
    try:
        return connection, schema.check_schema(connection, path)
    except (sqlite3.Error, UnicodeError) as error:
        connection.close()
        if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_READONLY_ROLLBACK and not rolled_back:
            _roll_back(path)
            return _connect_read_only(path, rolled_back=True)
        raise JournalError(f"{path} cannot be read: {_describe_with_remedy(error, path)}") from error
    except JournalError:
        connection.close()
        raise


def _has_log(path: Path) -> bool:
    """Whether a write-ahead log holds what is not in the journal's file yet."""
    try:
        return Path(f"{path}-wal").stat().st_size > 0
    except OSError:
        return False


def _roll_back(path: Path) -> None:
    """Roll back a transaction that a killed coordinator left in a rollback journal; a read-only connection cannot."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(path, timeout=5)) as connection:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()


def _is_locked(error: Exception) -> bool:
    """Whether another program, such as SQLite's shell, locks the journal."""
    return isinstance(error, sqlite3.Error) and getattr(error, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_BUSY


def _describe_with_remedy(error: Exception, path: Path) -> str:
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if code in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_IOERR) and (problem := lock_problem(path.parent)):
        return f"{one_line(str(error))}; {problem}"
    if code == sqlite3.SQLITE_CANTOPEN and _has_log(path):
        return f"its last part is in {path.name}-wal, which cannot be read in a read-only folder: copy the folder first"
    what = "end the program that keeps it locked" if _is_locked(error) else "restore it from a copy"
    return f"{one_line(str(error))}; {what}"
