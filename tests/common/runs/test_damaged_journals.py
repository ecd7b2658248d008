"""Damaged journals: each value is read, or is a one-line error; and many threads that read one run.

What of SQLite's errors is damage, and what is not. Tests run_folder.py, common/files/sqlite.py,
common/runs/journal/journal_reader.py and common/runs/journal/schema.py."""

import gc
import json
import os
import random
import resource
import shutil
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from threading import Barrier

import pytest

from dreamfleet.common.errors import DamagedJournalError, JournalError, NotWritableNowError
from dreamfleet.common.runs.journal.schema import APPLICATION_ID, VERSION
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.coordinator.storage.journal_file import journal_errors
from tests.support.journals import change_journal
from tests.support.mutations import mutate

VALUES = [None, "x", b"x", -1, 2**62, 1e308, "1e5", "[" * 3000, "9" * 5000, "\ud7ff"]


@pytest.fixture
def folder(runs):
    return runs / "dream"


def look(folder):
    """Read everything in a journal."""
    with RunFolder(folder) as run:
        assert run.settings.population > 1
        run.history(), run.evaluations(), run.rollouts(), run.strategy_state(), run.result_count()
        run.candidates(), run.scores(1), run.scores(1, confirming=True)
        run.uid, run.created, run.ended, run.fingerprint  # noqa: B018
        run.candidate(0, 0), run.fitness(0, 0), run.results(0, 0), run.classes.description


def test_a_killed_coordinators_open_transaction_is_rolled_back(folder, tmp_path):
    """Until it switches to its write-ahead log, a journal has a rollback journal, which a reader cannot roll back."""
    path = folder / "journal.sqlite"
    with closing(sqlite3.connect(path, isolation_level=None)) as writer, writer:
        writer.execute("PRAGMA journal_mode = DELETE")
        writer.execute("PRAGMA cache_size = 1")  # so that pages are written before the commit
        writer.execute("BEGIN")
        writer.execute("CREATE TABLE more (content BLOB)")
        for _ in range(100):
            writer.execute("INSERT INTO more VALUES (zeroblob(4000))")
        writer.execute("UPDATE run SET value = 'x'")
        killed = shutil.copytree(folder, tmp_path / "killed")
        writer.execute("ROLLBACK")
    writer.close()
    assert (killed / "journal.sqlite-journal").exists()
    killed = killed.rename(killed.with_name("50%20 #1 ?mode=rwc"))  # a name with characters of a URI
    look(killed)
    with RunFolder(killed) as run, RunFolder(folder) as own:
        assert (run.uid, run.settings) == (own.uid, own.settings)


@pytest.mark.slow
def test_damaged_pages(folder, watched):
    path = folder / "journal.sqlite"
    whole, source, read = path.read_bytes(), random.Random(5), 0
    for _ in range(500):
        path.write_bytes(mutate(source, whole, [whole]))
        read += watched.read(JournalError, look, folder)
    assert 0 < read < 500


def loose(path):
    """The same rows in tables without type checks, as another program might have written them."""
    with closing(sqlite3.connect(path)) as old:
        names = [name for (name,) in old.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        tables = {name: [each[1] for each in old.execute(f"PRAGMA table_info({name})")] for name in names}
        rows = {name: old.execute(f"SELECT * FROM {name}").fetchall() for name in names}
    path.unlink()
    with closing(sqlite3.connect(path)) as new, new:
        for name, columns in tables.items():
            new.execute(f"CREATE TABLE {name} ({', '.join(columns)})")
            new.executemany(f"INSERT INTO {name} VALUES ({', '.join('?' * len(columns))})", rows[name])
        new.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        new.execute(f"PRAGMA user_version = {VERSION}")
    return tables


@pytest.mark.slow
def test_values_of_other_types(folder, watched):
    path = folder / "journal.sqlite"
    tables = loose(path)
    look(folder)
    whole = path.read_bytes()
    for table, columns in tables.items():
        for column in columns:
            for value in VALUES:
                path.write_bytes(whole)
                change_journal(folder, f"UPDATE {table} SET {column} = ?", value)
                watched.read(JournalError, look, folder)


@pytest.mark.parametrize("table", ["run", "generation", "candidate", "evaluation", "result", "strategy"])
def test_missing_tables(folder, watched, table):
    change_journal(folder, f"DROP TABLE {table}")
    assert not watched.read(JournalError, look, folder)


def test_a_query_that_never_ends_is_not_run(folder):
    endless = "WITH RECURSIVE n(key, value) AS (SELECT 1, 1 UNION ALL SELECT key + 1, 2 FROM n) SELECT * FROM n"
    for statement in ("DROP TABLE run", f"CREATE VIEW run AS {endless}"):
        change_journal(folder, statement)
    with pytest.raises(JournalError):
        look(folder)


def test_a_journal_that_is_no_file_is_a_one_line_error(tmp_path, watched):
    makers = {"pipe": os.mkfifo, "folder": Path.mkdir, "endless": lambda journal: journal.symlink_to("/dev/zero")}
    for name, make in makers.items():
        (tmp_path / name).mkdir()
        make(tmp_path / name / "journal.sqlite")
        assert not watched.read(JournalError, open_run, tmp_path, name)
    assert not watched.read(JournalError, open_run, tmp_path / ("x" * 5000), "night")


def test_a_score_of_no_episodes_and_settings_with_an_unknown_field_are_refused(folder):
    set_fact = "INSERT OR REPLACE INTO run VALUES (?, ?)"
    with RunFolder(folder) as run:
        known = json.loads(run.settings.to_json())
    score = {"generation": 1, "episodes": 0, "mean": 1.0, "std": 1.0, "closed": 9}
    change_journal(folder, set_fact, "confirmed", json.dumps(score))
    with RunFolder(folder) as run, pytest.raises(JournalError):
        run.confirmation()
    change_journal(folder, set_fact, "settings", json.dumps({**known, "of_tomorrow": 1}))
    with RunFolder(folder) as run, pytest.raises(JournalError):
        run.settings  # noqa: B018


def test_a_locked_journal_is_not_called_damaged(folder, monkeypatch):
    other = sqlite3.connect(folder / "journal.sqlite", isolation_level=None)
    other.execute("PRAGMA journal_mode = delete")
    other.execute("BEGIN EXCLUSIVE")
    connect = sqlite3.connect
    monkeypatch.setattr(sqlite3, "connect", lambda *args, **more: connect(*args, **{**more, "timeout": 0}))
    with pytest.raises(JournalError, match="database is locked"):
        RunFolder(folder)
    other.execute("ROLLBACK")
    with RunFolder(folder) as run:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(JournalError, match="database is locked"):
            run.history()
    other.close()


THREADS = 4


def in_thread(call, *given):
    """What a call gives in a thread of its own, which then ends."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(call, *given).result()


def descriptors(folder):
    """The open files of this process that lie in the folder."""
    found = []
    for each in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # the one that lists them
            found.append(str(each.readlink()))
    return [each for each in found if each.startswith(str(folder))]


def look_at(run):
    with run.read_transaction():
        return run.history(), run.candidates(), run.evaluations(), run.uid, run.results(0, 0)


def test_threads_read_a_run_that_another_one_opened(folder):
    together = Barrier(THREADS)

    def at_once(run):
        together.wait()
        return [look_at(run) for _ in range(5)]

    with RunFolder(folder) as run:
        here = look_at(run)
        with ThreadPoolExecutor(THREADS) as pool:
            there = [each.result() for each in [pool.submit(at_once, run) for _ in range(THREADS)]]
        assert all(found == here for some in there for found in some)


def test_a_transaction_is_its_threads_own(folder):
    with RunFolder(folder) as run, run.read_transaction():
        before = run.uid
        change_journal(folder, "UPDATE run SET value = 'another' WHERE key = 'uid'")
        assert run.uid == before
        assert in_thread(lambda: run.uid) == "another"
        assert run.uid == before


def test_threads_that_ended_hold_nothing_and_any_thread_closes_it_for_all(folder):
    run = RunFolder(folder)
    run.history()
    opened = len(descriptors(folder))
    for _ in range(5):
        in_thread(run.history)
    gc.collect()
    assert len(descriptors(folder)) <= opened + 1  # SQLite keeps a file until nobody in the process has it
    with ThreadPoolExecutor(1) as pool:
        pool.submit(run.history).result()
        in_thread(run.close)
        for look_again in (run.history, lambda: pool.submit(run.history).result()):
            with pytest.raises(JournalError) as found:
                look_again()
            assert not isinstance(found.value, DamagedJournalError)
        assert not descriptors(folder)


def test_only_sqlites_own_verdict_is_damage(folder):
    """A number that no journal holds, and a process without a free file, say nothing about the journal."""
    with RunFolder(folder) as run:
        for call in (lambda: run.candidate(2**80, 0), lambda: run.results(0, 0, "\ud800")):
            with pytest.raises(JournalError) as found:
                call()
            assert not isinstance(found.value, DamagedJournalError)
        with ThreadPoolExecutor(1) as pool:
            pool.submit(abs, 1).result()  # its thread begins
            soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
            resource.setrlimit(resource.RLIMIT_NOFILE, (0, hard))  # this process can open no further file
            try:
                error = pool.submit(run.history).exception()
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        assert isinstance(error, JournalError)
        assert not isinstance(error, DamagedJournalError)
        assert look_at(run)[0]


def test_pages_that_sqlite_cannot_read_are_damage(folder):
    path = folder / "journal.sqlite"
    whole = path.read_bytes()
    path.write_bytes(whole[:4096] + b"\xff" * (len(whole) - 4096))
    with pytest.raises(DamagedJournalError), RunFolder(folder) as run:
        look_at(run)
    with pytest.raises(DamagedJournalError), closing(Journal(path)) as journal:
        journal.generation(0)
    for content in (b"SQLite format 3\0" + b"\xff" * 5000, b"no journal" * 500):
        path.write_bytes(content)
        with pytest.raises(DamagedJournalError):
            RunFolder(folder)


def test_text_of_other_bytes_is_damage(folder):
    change_journal(folder, "UPDATE run SET value = CAST(x'ff' AS TEXT) WHERE key = 'uid'")
    with RunFolder(folder) as run, pytest.raises(DamagedJournalError):
        run.uid  # noqa: B018
    with closing(Journal(folder / "journal.sqlite")) as journal, pytest.raises(DamagedJournalError):
        journal.fact("uid")


@pytest.mark.parametrize(
    "misuse",
    [
        lambda database: in_thread(database.execute, "SELECT 1"),  # of another thread
        lambda database: (database.close(), database.execute("SELECT 1")),
        lambda database: database.execute("SELECT ?"),
        lambda database: database.execute("SELECT ?", (object(),)),
        lambda database: database.execute("SELECT zeroblob(1 << 40)"),
    ],
)
def test_what_this_program_does_wrong_is_no_damage(folder, misuse):
    path = folder / "journal.sqlite"
    with closing(sqlite3.connect(path)) as database, pytest.raises(JournalError) as found, journal_errors(path):
        misuse(database)
    assert not isinstance(found.value, DamagedJournalError | NotWritableNowError)
