"""The SQLite file of a journal: its side files, its stamp, a check, a checked copy, and SQLite's errors in words."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from dreamfleet.common.errors import DamagedJournalError, DreamfleetError, JournalError, NotWritableNowError
from dreamfleet.common.files.file_system import disk_problem
from dreamfleet.common.files.sqlite import is_damage
from dreamfleet.common.printable import one_line

REMEDIES = {
    sqlite3.SQLITE_FULL: "make room",
    sqlite3.SQLITE_BUSY: "end the program that keeps it locked",
}  # of errors after which the same writes may succeed later; docs/how-to/troubleshooting.md


def check_database(connection: sqlite3.Connection) -> tuple[str, int | None]:
    """SQLite's quick check of a journal, "ok" if it is sound, and the number of its latest generation."""
    found = str(connection.execute("PRAGMA quick_check(1)").fetchone()[0])
    if found != "ok":
        return found, None
    return found, connection.execute("SELECT max(number) FROM generation").fetchone()[0]


def copy_database(source: sqlite3.Connection, path: Path) -> tuple[str, int | None]:
    """Copy all that is committed into one new file, and check the copy as `check_database` does."""
    with closing(sqlite3.connect(path)) as copy:
        source.backup(copy)
        copy.execute("PRAGMA journal_mode = DELETE")  # one file, without a log beside it
        return check_database(copy)


def file_stamp(path: Path) -> tuple[int, int] | None:
    """The time of a file's last write, and its size; `None` if there is no file."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def sqlite_side_files(path: Path) -> tuple[Path, ...]:
    """The files that SQLite may write beside a database: write-ahead log, that log's index, rollback journal."""
    return tuple(path.with_name(path.name + end) for end in ("-wal", "-shm", "-journal"))


@contextmanager
def journal_errors(path: Path) -> Iterator[None]:
    """Raise SQLite's errors as `JournalError`, in one line that says what to do."""
    try:
        yield
    except DreamfleetError:
        raise
    except sqlite3.IntegrityError as error:
        raise JournalError(
            f"{path} was not written: {error}; what was committed before is whole, and the run can be continued"
        ) from error
    except (sqlite3.Error, UnicodeError) as error:
        if is_damage(error):
            raise DamagedJournalError(
                f"{path} is damaged or no journal: {one_line(str(error))}; restore it from a copy"
            ) from error
        if (remedy := REMEDIES.get(getattr(error, "sqlite_errorcode", 0) & 0xFF)) is not None:
            raise NotWritableNowError(f"cannot write {path}: {error}; {remedy}") from error
        problem = f"; {text}" if (text := disk_problem(path.parent)) else ""
        raise JournalError(
            f"cannot write {path}: {error}; nothing counted that was not written before{problem}"
        ) from error
