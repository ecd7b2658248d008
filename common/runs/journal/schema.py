"""The journal's tables. A journal of another schema version is refused and left as it is. Pages: upgrade.md."""

import sqlite3
from contextlib import closing
from functools import cache

from dreamfleet.common.errors import DamagedJournalError, JournalError

APPLICATION_ID = 0x64666C74  # "dflt": marks the SQLite file as ours
VERSION = 12
# Results lie in the order in which they come, so a commit changes few pages, however long the run is.
TABLES = """
    CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
    CREATE TABLE generation (
        number INTEGER PRIMARY KEY, seeds TEXT NOT NULL, opened REAL NOT NULL, closed REAL,
        mean REAL, std REAL, best REAL, worst REAL, sigma REAL NOT NULL, steps INTEGER, seconds REAL,
        failed INTEGER NOT NULL DEFAULT 0, checksum BLOB
    ) STRICT;
    CREATE TABLE candidate (
        generation INTEGER NOT NULL, number INTEGER NOT NULL, vector BLOB NOT NULL, fitness REAL, measures TEXT,
        PRIMARY KEY (generation, number)
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE redraw (
        generation INTEGER NOT NULL, round INTEGER NOT NULL, candidate INTEGER NOT NULL, vector BLOB NOT NULL,
        PRIMARY KEY (generation, round, candidate)
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE strategy (generation INTEGER PRIMARY KEY, state BLOB NOT NULL, checksum BLOB) STRICT;
    CREATE TABLE evaluation (
        generation INTEGER PRIMARY KEY, vector BLOB NOT NULL, episodes INTEGER NOT NULL, mean REAL, std REAL,
        failed INTEGER NOT NULL DEFAULT 0, checksum BLOB
    ) STRICT;
    CREATE TABLE collection (
        generation INTEGER PRIMARY KEY, vector BLOB NOT NULL, episodes INTEGER NOT NULL
    ) STRICT;
    CREATE TABLE result (
        digest BLOB NOT NULL, kind TEXT NOT NULL, generation INTEGER NOT NULL, candidate INTEGER NOT NULL,
        episode INTEGER NOT NULL, seed INTEGER NOT NULL, fitness REAL NOT NULL, steps INTEGER NOT NULL,
        seconds REAL NOT NULL, worker TEXT NOT NULL, fingerprint TEXT NOT NULL, incarnation INTEGER NOT NULL,
        host_class TEXT NOT NULL, measures TEXT,
        PRIMARY KEY (kind, generation, candidate, episode, digest)
    ) STRICT, WITHOUT ROWID;
    CREATE INDEX evaluation_digest ON result (digest) WHERE kind = 'evaluate';
    CREATE TABLE failure (
        digest BLOB PRIMARY KEY, kind TEXT NOT NULL, generation INTEGER NOT NULL, candidate INTEGER NOT NULL,
        episode INTEGER NOT NULL, seed INTEGER NOT NULL, error TEXT NOT NULL, workers TEXT NOT NULL,
        attempts INTEGER NOT NULL, incarnation INTEGER NOT NULL, happened REAL NOT NULL,
        cause TEXT NOT NULL DEFAULT '', fault TEXT NOT NULL DEFAULT 'other'
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE verification (
        digest BLOB NOT NULL, kind TEXT NOT NULL, generation INTEGER NOT NULL, worker TEXT NOT NULL,
        checker TEXT NOT NULL, outcome TEXT NOT NULL, happened REAL NOT NULL, stands INTEGER NOT NULL DEFAULT 1
    ) STRICT;
    CREATE INDEX verification_digest ON verification (digest);
    CREATE TABLE barred (
        host TEXT PRIMARY KEY, why TEXT NOT NULL, by_trusted INTEGER NOT NULL, incarnation INTEGER NOT NULL,
        happened REAL NOT NULL, by_operator INTEGER NOT NULL DEFAULT 0
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE recalled (
        digest BLOB NOT NULL, kind TEXT NOT NULL, generation INTEGER NOT NULL, candidate INTEGER NOT NULL,
        episode INTEGER NOT NULL, seed INTEGER NOT NULL, fitness REAL NOT NULL, steps INTEGER NOT NULL,
        seconds REAL NOT NULL, worker TEXT NOT NULL, fingerprint TEXT NOT NULL, incarnation INTEGER NOT NULL,
        host_class TEXT NOT NULL, measures TEXT, because TEXT NOT NULL, happened REAL NOT NULL, was_closed INTEGER
    ) STRICT;
    CREATE INDEX recalled_digest ON recalled (digest);
    CREATE TABLE batch (
        number INTEGER PRIMARY KEY, id TEXT NOT NULL UNIQUE, content BLOB NOT NULL, seeds TEXT NOT NULL,
        population INTEGER NOT NULL, vectors BLOB, submitted REAL NOT NULL, generation INTEGER UNIQUE,
        state TEXT NOT NULL, errors TEXT NOT NULL DEFAULT '{}'
    ) STRICT;
    CREATE INDEX waiting_batch ON batch (number) WHERE state = 'waiting';
    CREATE INDEX open_batch ON batch (number) WHERE state IN ('running', 'waiting');
    CREATE TABLE event (
        number INTEGER PRIMARY KEY, happened REAL NOT NULL, incarnation INTEGER NOT NULL, text TEXT NOT NULL,
        what TEXT NOT NULL DEFAULT '', worker TEXT NOT NULL DEFAULT ''
    ) STRICT;
"""

# Objects that execute somebody else's SQL, possibly for ever, when a table is read.
_FOREIGN = (
    "SELECT count(*) FROM sqlite_master WHERE type NOT IN ('table', 'index') "
    "OR sql LIKE 'CREATE VIRTUAL%' OR sql LIKE '%GENERATED%'"
)
_COLUMNS = "SELECT m.name, c.name FROM sqlite_master m JOIN pragma_table_info(m.name) c WHERE m.type = 'table'"


def check_schema(connection: sqlite3.Connection, path: object) -> None:
    """Check that an open journal has our tables; `JournalError` if it is foreign or of another version."""
    (mark,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    (foreign,) = connection.execute(_FOREIGN).fetchone()
    if foreign:
        raise JournalError(f"{path} holds views, triggers or virtual tables, which no journal of dreamfleet has")
    if mark != APPLICATION_ID:
        raise JournalError(f"{path} is not a journal of dreamfleet; nothing was changed")
    if version != VERSION:
        raise JournalError(
            f"{path} has schema version {version}, this program reads {VERSION} alone: install the dreamfleet that "
            "wrote it; nothing was changed"
        )
    if not _columns() <= {*connection.execute(_COLUMNS)}:
        raise DamagedJournalError(f"{path} is damaged: it lacks tables or columns; restore it from a copy")


@cache
def _columns() -> frozenset[tuple[str, str]]:
    with closing(sqlite3.connect(":memory:")) as connection:
        create_tables(connection)
        return frozenset(connection.execute(_COLUMNS))


def create_tables(connection: sqlite3.Connection) -> None:
    """Make an empty database a journal, in one transaction."""
    connection.executescript(
        f"BEGIN IMMEDIATE; {TABLES} PRAGMA application_id = {APPLICATION_ID}; PRAGMA user_version = {VERSION}; COMMIT;"
    )
