"""One open run in many threads; and what of SQLite's errors is damage, and what is not.
Tests common/files/sqlite.py."""

import gc
import resource
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from threading import Barrier

import pytest

from dreamfleet.common.errors import DamagedJournalError, JournalError, NotWritableNowError
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.coordinator.storage.journal_file import journal_errors
from tests.support.journals import change_journal

THREADS = 4


@pytest.fixture
def folder(runs):
    return runs / "dream"


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


def look(run):
    with run.read_transaction():
        return run.history(), run.candidates(), run.evaluations(), run.uid, run.results(0, 0)


def test_threads_read_a_run_that_another_one_opened(folder):
    together = Barrier(THREADS)

    def at_once(run):
        together.wait()
        return [look(run) for _ in range(5)]

    with RunFolder(folder) as run:
        here = look(run)
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
        assert look(run)[0]


def test_pages_that_sqlite_cannot_read_are_damage(folder):
    path = folder / "journal.sqlite"
    whole = path.read_bytes()
    path.write_bytes(whole[:4096] + b"\xff" * (len(whole) - 4096))
    with pytest.raises(DamagedJournalError), RunFolder(folder) as run:
        look(run)
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
