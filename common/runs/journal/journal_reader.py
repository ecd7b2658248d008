"""The read-only connection to a run's journal, and its larger queries."""

import os
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from types import NoneType
from typing import Any

from dreamfleet.common.errors import DamagedJournalError, JournalError
from dreamfleet.common.files.file_system import disk_problem, lock_problem
from dreamfleet.common.files.regular_files import check_regular
from dreamfleet.common.files.sqlite import ThreadConnections, is_damage, is_locked
from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol.check_counts import CheckCounts
from dreamfleet.common.runs.journal import schema
from dreamfleet.common.runs.seeds import CHOOSING_OFFSET
from dreamfleet.common.runs.stages import BegunStage

_TYPES: dict[str, tuple[type, ...]] = {
    "i": (int,), "f": (int, float), "F": (int, float, NoneType), "s": (str,), "b": (bytes,),
    "n": (bytes, NoneType),
}  # fmt: skip


class JournalReader:
    """A read-only journal at `path`, with a connection for each thread; every failure is a `JournalError`."""

    def __init__(self, path: Path) -> None:
        self._run, self._path = path.parent.name, path
        self._connections = ThreadConnections(lambda: _connect_read_only(path))
        self._connections.add_own(_connect_read_only(path))

    def close(self) -> None:
        """Release the journal, for all threads."""
        self._connections.close()
        _remove_empty_log(self._path)

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """Queries inside see one state of the journal, whatever a coordinator writes meanwhile; may be nested.

        It holds for the calling thread.
        """
        if not self._connections.is_closed and self._connections.own.database.in_transaction:
            yield
            return
        self.read("BEGIN")  # deferred: the first query fixes the state
        try:
            yield
        finally:
            with suppress(JournalError):
                self.read("ROLLBACK")

    def rows(self, kinds: str, query: str, *values: Any) -> list[Any]:
        """All rows of a query, checked for their column types.

        `kinds` has a letter for each column: i integer, f number, F number or NULL, s text, b bytes, n bytes or NULL.
        A damaged page, or another program, may have left other types.
        """
        found, types = self.read(query, *values), [_TYPES[each] for each in kinds]
        if not all(all(map(isinstance, row, types)) for row in found):
            raise self.damage_error("a row holds values of another type")
        return found

    def row(self, query: str, *values: Any) -> Any:
        """The first row of a query, unchecked; `None` if there is none."""
        found = self.read(query, *values)
        return found[0] if found else None

    def fact(self, key: str) -> str | None:
        """One of the run's facts; `None` if it has no such fact."""
        row = self.row("SELECT value FROM run WHERE key = ?", key)
        return None if row is None else str(row[0])

    def check_counts(self, share: float) -> CheckCounts | None:
        """Outcomes of checking the `share` of results; `None` if nothing is checked and nobody is barred."""
        counts = dict(self.rows("si", "SELECT outcome, count(*) FROM verification GROUP BY 1"))
        (counts["recalled"],) = self.row("SELECT count(*) FROM recalled WHERE because = 'barred'")
        return CheckCounts.of(share, counts, self.rows("si", "SELECT host, by_operator FROM barred ORDER BY happened"))

    def damage_error(self, what: str) -> DamagedJournalError:
        """The error for a damaged journal."""
        return DamagedJournalError(f"the journal of run {self._run} is damaged: {what}; restore it from a copy")

    def read(self, query: str, *values: Any) -> list[Any]:
        """All rows of a query, unchecked."""
        if self._connections.is_closed:
            raise self._closed_error()
        own = self._connections.own
        try:
            with own.lock:
                return own.database.execute(query, values).fetchall()
        except (sqlite3.Error, OverflowError, UnicodeError) as error:
            if self._connections.is_closed:  # meanwhile, by another thread
                raise self._closed_error() from error
            if is_damage(error):
                raise self.damage_error(one_line(str(error))) from error
            raise JournalError(
                f"the journal of run {self._run} cannot be read: {_describe_with_remedy(error, self._path)}"
            ) from error

    def _closed_error(self) -> JournalError:
        return JournalError(f"run {self._run} was closed here: open it again")


# Numbers of results by host class and fingerprint.
CLASS_COUNTS_QUERY = "SELECT host_class, fingerprint, count(*) FROM result GROUP BY 1, 2"
# The results of one kind, generation and candidate, by episode.
RESULTS_QUERY = (
    "SELECT kind, generation, candidate, episode, seed, fitness, steps, seconds, worker, fingerprint, host_class, "
    "hex(digest) FROM result WHERE kind = ? AND generation = ? AND candidate = ? ORDER BY episode"
)


MOST_VARIABLES = 500  # of one SQL statement


def digest_terms(digests: Sequence[bytes]) -> Iterator[tuple[str, Sequence[bytes]]]:
    """Conditions that together find the rows with these digests, each with its values."""
    for start in range(0, len(digests), MOST_VARIABLES):
        some = digests[start : start + MOST_VARIABLES]
        yield f"digest IN ({', '.join('?' * len(some))})", some


def efforts_query(begun: Sequence[BegunStage]) -> str:
    """Sum steps and time by kind, generation, and whether results confirm the report or were driven in reality.

    Columns: kind, generation, confirming, driven, steps, microseconds. Sums are floats, which cannot overflow.
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


def _connect_read_only(path: Path, *, rolled_back: bool = False) -> sqlite3.Connection:
    # In a read-only folder SQLite cannot create the shared-memory file. It needs none where no write-ahead log is left.
    immutable = "" if os.access(path.parent, os.W_OK) or _has_log(path) else "&immutable=1"
    try:
        check_regular(path)  # SQLite would block on a pipe
        where = f"{path.absolute().as_uri()}?mode=ro{immutable}"
        connection = sqlite3.connect(where, uri=True, check_same_thread=False)  # another thread may close it
    except (sqlite3.Error, OSError) as error:
        raise JournalError(f"{path} cannot be read: {error}") from error
    try:
        schema.check_schema(connection, path)
        return connection
    except (sqlite3.Error, UnicodeError) as error:
        connection.close()
        if getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_READONLY_ROLLBACK and not rolled_back:
            _roll_back(path)
            return _connect_read_only(path, rolled_back=True)
        kind = DamagedJournalError if is_damage(error) else JournalError
        raise kind(f"{path} cannot be read: {_describe_with_remedy(error, path)}") from error
    except JournalError:
        connection.close()
        raise


def _has_log(path: Path) -> bool:
    """Whether a write-ahead log holds what is not in the journal's file yet."""
    try:
        return Path(f"{path}-wal").stat().st_size > 0
    except OSError:
        return False


def _remove_empty_log(path: Path) -> None:
    """Let SQLite remove an empty log and its index, which a read-only connection makes and cannot remove.

    It does so as the last connection closes, which a coordinator's is where one serves the run.
    """
    if _has_log(path) or not Path(f"{path}-shm").exists() or not os.access(path.parent, os.W_OK):
        return
    with (
        suppress(sqlite3.Error),
        closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=rw", uri=True, timeout=0)) as last,
    ):
        last.execute("SELECT count(*) FROM sqlite_master").fetchone()


def _roll_back(path: Path) -> None:
    """Roll back a transaction that a killed coordinator left in a rollback journal; a read-only connection cannot."""
    with suppress(sqlite3.Error), closing(sqlite3.connect(path, timeout=5)) as connection:
        connection.execute("SELECT count(*) FROM sqlite_master").fetchone()


def _describe_with_remedy(error: Exception, path: Path) -> str:
    code = getattr(error, "sqlite_errorcode", 0) & 0xFF
    causes = {sqlite3.SQLITE_BUSY: lock_problem, sqlite3.SQLITE_IOERR: disk_problem}
    if (find := causes.get(code)) and (problem := find(path.parent)):
        return f"{one_line(str(error))}; {problem}"
    if code == sqlite3.SQLITE_CANTOPEN and _has_log(path):
        return f"its last part is in {path.name}-wal, which cannot be read in a read-only folder: copy the folder first"
    if is_locked(error):
        return f"{one_line(str(error))}; end the program that keeps it locked"
    return one_line(str(error)) + ("; restore it from a copy" if is_damage(error) else "")
