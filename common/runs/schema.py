"""The journal's tables, and the migration of older journals."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from functools import cache

from dreamfleet.common.errors import DamagedJournalError, JournalError

APPLICATION_ID = 0x64666C74  # "dflt": marks the SQLite file as ours
MIGRATIONS = (
    """
    CREATE TABLE run (key TEXT PRIMARY KEY, value TEXT NOT NULL) STRICT;
    CREATE TABLE generation (
        number INTEGER PRIMARY KEY, seeds TEXT NOT NULL, opened REAL NOT NULL, closed REAL,
        mean REAL, std REAL, best REAL, worst REAL, sigma REAL NOT NULL, steps INTEGER, seconds REAL
    ) STRICT;
    CREATE TABLE candidate (
        generation INTEGER NOT NULL, number INTEGER NOT NULL, vector BLOB NOT NULL, fitness REAL,
        PRIMARY KEY (generation, number)
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE evaluation (
        generation INTEGER PRIMARY KEY, vector BLOB NOT NULL, episodes INTEGER NOT NULL, mean REAL, std REAL
    ) STRICT;
    CREATE TABLE result (
        digest BLOB PRIMARY KEY, kind TEXT NOT NULL, generation INTEGER NOT NULL, candidate INTEGER NOT NULL,
        episode INTEGER NOT NULL, seed INTEGER NOT NULL, fitness REAL NOT NULL, steps INTEGER NOT NULL,
        seconds REAL NOT NULL, worker TEXT NOT NULL, fingerprint TEXT NOT NULL, incarnation INTEGER NOT NULL
    ) STRICT, WITHOUT ROWID;
    CREATE INDEX result_of_candidate ON result (kind, generation, candidate, episode);
    CREATE TABLE strategy (generation INTEGER PRIMARY KEY, state BLOB NOT NULL) STRICT;
    """,
    """
    CREATE TABLE collection (
        generation INTEGER PRIMARY KEY, vector BLOB NOT NULL, episodes INTEGER NOT NULL
    ) STRICT;
    """,
    "ALTER TABLE result ADD COLUMN host_class TEXT NOT NULL DEFAULT '';",
    """
    CREATE TABLE failure (
        digest BLOB PRIMARY KEY, kind TEXT NOT NULL, generation INTEGER NOT NULL, candidate INTEGER NOT NULL,
        episode INTEGER NOT NULL, seed INTEGER NOT NULL, error TEXT NOT NULL, workers TEXT NOT NULL,
        attempts INTEGER NOT NULL, incarnation INTEGER NOT NULL, happened REAL NOT NULL
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE redraw (
        generation INTEGER NOT NULL, round INTEGER NOT NULL, candidate INTEGER NOT NULL, vector BLOB NOT NULL,
        PRIMARY KEY (generation, round, candidate)
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE event (
        number INTEGER PRIMARY KEY, happened REAL NOT NULL, incarnation INTEGER NOT NULL, text TEXT NOT NULL
    ) STRICT;
    ALTER TABLE generation ADD COLUMN failed INTEGER NOT NULL DEFAULT 0;
    ALTER TABLE evaluation ADD COLUMN failed INTEGER NOT NULL DEFAULT 0;
    """,
    """
    ALTER TABLE result ADD COLUMN measures TEXT;
    ALTER TABLE candidate ADD COLUMN measures TEXT;
    """,
    """
    CREATE TABLE batch (
        number INTEGER PRIMARY KEY, id TEXT NOT NULL UNIQUE, content BLOB NOT NULL, seeds TEXT NOT NULL,
        population INTEGER NOT NULL, vectors BLOB, submitted REAL NOT NULL, generation INTEGER UNIQUE,
        state TEXT NOT NULL, errors TEXT NOT NULL DEFAULT '{}'
    ) STRICT;
    CREATE INDEX waiting_batch ON batch (number) WHERE state = 'waiting';
    """,
    """
    CREATE TABLE verification (
        digest BLOB NOT NULL, kind TEXT NOT NULL, generation INTEGER NOT NULL, worker TEXT NOT NULL,
        checker TEXT NOT NULL, outcome TEXT NOT NULL, happened REAL NOT NULL, stands INTEGER NOT NULL DEFAULT 1
    ) STRICT;
    CREATE INDEX verification_digest ON verification (digest);
    CREATE TABLE barred (
        host TEXT PRIMARY KEY, why TEXT NOT NULL, by_anchor INTEGER NOT NULL, incarnation INTEGER NOT NULL,
        happened REAL NOT NULL
    ) STRICT, WITHOUT ROWID;
    CREATE TABLE recalled (
        digest BLOB NOT NULL, kind TEXT NOT NULL, generation INTEGER NOT NULL, candidate INTEGER NOT NULL,
        episode INTEGER NOT NULL, seed INTEGER NOT NULL, fitness REAL NOT NULL, steps INTEGER NOT NULL,
        seconds REAL NOT NULL, worker TEXT NOT NULL, fingerprint TEXT NOT NULL, incarnation INTEGER NOT NULL,
        host_class TEXT NOT NULL, measures TEXT, because TEXT NOT NULL, happened REAL NOT NULL
    ) STRICT;
    CREATE INDEX recalled_digest ON recalled (digest);
    CREATE INDEX open_batch ON batch (number) WHERE state IN ('running', 'waiting');
    """,
    "ALTER TABLE barred ADD COLUMN by_operator INTEGER NOT NULL DEFAULT 0;",
    # Results lie in the order in which they come, so a commit changes few pages, however long the run is.
    """
    CREATE TABLE placed (
        digest BLOB NOT NULL, kind TEXT NOT NULL, generation INTEGER NOT NULL, candidate INTEGER NOT NULL,
        episode INTEGER NOT NULL, seed INTEGER NOT NULL, fitness REAL NOT NULL, steps INTEGER NOT NULL,
        seconds REAL NOT NULL, worker TEXT NOT NULL, fingerprint TEXT NOT NULL, incarnation INTEGER NOT NULL,
        host_class TEXT NOT NULL DEFAULT '', measures TEXT,
        PRIMARY KEY (kind, generation, candidate, episode, digest)
    ) STRICT, WITHOUT ROWID;
    INSERT INTO placed SELECT digest, kind, generation, candidate, episode, seed, fitness, steps, seconds, worker,
        fingerprint, incarnation, host_class, measures FROM result ORDER BY kind, generation, candidate, episode;
    DROP TABLE result;
    ALTER TABLE placed RENAME TO result;
    CREATE INDEX evaluation_digest ON result (digest) WHERE kind = 'evaluate';
    """,
    """
    ALTER TABLE generation ADD COLUMN checksum BLOB;
    ALTER TABLE evaluation ADD COLUMN checksum BLOB;
    ALTER TABLE strategy ADD COLUMN checksum BLOB;
    ALTER TABLE recalled ADD COLUMN was_closed INTEGER;
    """,
    """
    ALTER TABLE failure ADD COLUMN cause TEXT NOT NULL DEFAULT '';
    ALTER TABLE failure ADD COLUMN fault TEXT NOT NULL DEFAULT 'other';
    ALTER TABLE event ADD COLUMN what TEXT NOT NULL DEFAULT '';
    ALTER TABLE event ADD COLUMN worker TEXT NOT NULL DEFAULT '';
    """,
)
"""Entry i migrates a journal from version i to i + 1. Append only."""
VERSION = len(MIGRATIONS)
CHECKSUM_VERSION = 11  # the first version whose checksums are compared: those of an older one cover less, or are none
KINDS_VERSION = 11  # the first version whose failures and events are data beside their text
PLACED_VERSION = 9  # the first version whose results lie in the order in which they come
OPERATOR_VERSION = 7  # the first version that keeps which hosts the operator barred
VERIFICATION_VERSION = 6  # the first version with results that were checked, barred hosts and recalled results
MEASURES_VERSION = 5  # the first version with measures, JSON lists of numbers
FAILURE_VERSION = 4  # the first version with failures that are facts of the journal
HOST_CLASS_VERSION = 3  # the first version whose results have a host class; empty: derive it from the fingerprint


# Objects that execute somebody else's SQL, possibly for ever, when a table is read.
_FOREIGN = (
    "SELECT count(*) FROM sqlite_master WHERE type NOT IN ('table', 'index') "
    "OR sql LIKE 'CREATE VIRTUAL%' OR sql LIKE '%GENERATED%'"
)
_COLUMNS = "SELECT m.name, c.name FROM sqlite_master m JOIN pragma_table_info(m.name) c WHERE m.type = 'table'"


def check_schema(connection: sqlite3.Connection, path: object) -> int:
    """The schema version of an open journal; `JournalError` if it is foreign or newer than this program."""
    (mark,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    (foreign,) = connection.execute(_FOREIGN).fetchone()
    if foreign:
        raise JournalError(f"{path} holds views, triggers or virtual tables, which no journal of dreamfleet has")
    if mark != APPLICATION_ID:
        raise JournalError(f"{path} is not a journal of dreamfleet; nothing was changed")
    if version > VERSION:
        raise JournalError(
            f"{path} has schema version {version}, this program knows {VERSION}: install a newer dreamfleet"
        )
    found = {*connection.execute(_COLUMNS)}
    if version < 0 or found & _columns(VERSION) != _columns(version):
        raise DamagedJournalError(
            f"{path} is damaged: it is not of its schema version {version}; restore it from a copy"
        )
    return int(version)


@cache
def _columns(version: int) -> frozenset[tuple[str, str]]:
    """Tables and columns of a journal of this version."""
    with closing(sqlite3.connect(":memory:")) as connection:
        for script in MIGRATIONS[:version]:
            connection.executescript(script)
        return frozenset(connection.execute(_COLUMNS))


def migrate(connection: sqlite3.Connection, version: int) -> None:
    """Migrate an open journal from `version` to the current one, each step in a transaction."""
    connection.execute("PRAGMA secure_delete = OFF")  # else each page of a dropped table is written once more
    for number, script in enumerate(MIGRATIONS[version:], start=version + 1):
        connection.executescript(
            f"BEGIN IMMEDIATE; {script} PRAGMA application_id = {APPLICATION_ID}; "
            f"PRAGMA user_version = {number}; COMMIT;"
        )
