"""A live run whose files are removed, replaced or moved: nothing is lost, it says so soon, and it can be continued.
Tests coordinator/storage/file_watch.py and coordinator/storage/served_bundle.py."""

import errno
import os
import shlex
import shutil
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing

import pytest

from dreamfleet.common.errors import NotWritableNowError, write_error
from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks
from tests.support.processes import DEADLINE, environment, free_port, started


@pytest.fixture
def settings(random_bundle):
    return ("--bundle", random_bundle.path, "--population", 4, "--episodes", 1, "--evaluate-every", 0,
            "--task", tasks.SLOW_TOY, "--generations", 100_000)  # fmt: skip


@pytest.fixture
def live(processes, settings):
    """A run in its third generation, and its folder."""
    coordinator = processes.coordinator(*settings)
    processes.worker("--task", tasks.SLOW_TOY)
    coordinator.wait_for_event("generation", number=1)
    return coordinator, processes.runs / "test"


def said_of(coordinator):
    """How it ended, which is not as if nothing had happened."""
    code, _ = coordinator.finish()
    assert code == 1
    assert "Traceback" not in "".join(coordinator.lines)
    return coordinator.lines[-1]


def closed(coordinator):
    """How many generations its output reports as closed."""
    return len(coordinator.events("generation"))


def goes_on(processes, coordinator, said, name="test"):
    """The command that the error names continues the run, with its worker and every generation that was reported."""
    generations = closed(coordinator)
    command = said[said.index(sys.executable) :].strip()
    with started(
        [*shlex.split(command), "--generations", str(generations + 1), "--listen", processes.endpoint],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment(processes.cache),
    ) as again:  # fmt: skip
        _, err = again.communicate(timeout=DEADLINE)
        assert again.returncode == 0, err
    with open_run(processes.runs, name) as run:
        history = [(each.number, each.mean) for each in run.history()]
    assert [(each["number"], each["mean"]) for each in coordinator.events("generation")] == history[:-1]
    assert len(history) == generations + 1


@pytest.mark.slow
@pytest.mark.parametrize(
    "lost",
    [
        ("journal.sqlite",), pytest.param(("journal.sqlite-wal",), marks=pytest.mark.long),
        ("journal.sqlite", "journal.sqlite-wal", "journal.sqlite-shm"),
    ],
    ids=["journal", "log", "all"],
)  # fmt: skip
def test_a_journal_that_is_removed_is_rescued_under_its_own_name(processes, live, lost):
    coordinator, folder = live
    for name in lost:
        (folder / name).unlink()
    said = said_of(coordinator)
    assert str(folder / "journal.sqlite") in said
    goes_on(processes, coordinator, said)


@pytest.mark.slow
def test_a_folder_that_is_removed_is_rescued_beside_it(processes, live):
    coordinator, folder = live
    shutil.rmtree(folder)
    said = said_of(coordinator)
    assert str(processes.runs / "test-rescued" / "journal.sqlite") in said
    goes_on(processes, coordinator, said, "test-rescued")


@pytest.mark.slow
def test_a_journal_that_is_replaced_by_a_copy_is_rescued_and_the_copy_stays(processes, live):
    coordinator, folder = live
    copy = folder / "copy"
    shutil.copyfile(folder / "journal.sqlite", copy)
    data = copy.read_bytes()
    copy.replace(folder / "journal.sqlite")
    said = said_of(coordinator)
    assert (folder / "journal.sqlite").read_bytes() == data
    goes_on(processes, coordinator, said)


@pytest.mark.slow
def test_a_journal_that_others_read_is_no_reason_to_leave(processes, live):
    coordinator, folder = live
    for _ in range(5):
        with closing(sqlite3.connect(folder / "journal.sqlite")) as reader, reader:
            reader.execute("SELECT count(*) FROM result").fetchone()
            reader.execute("PRAGMA wal_checkpoint")
        reader.close()
        assert processes.call("runs", "show", "test", "--runs-dir", processes.runs)[0] == 0
    coordinator.wait_for_event("generation", times=2)
    assert coordinator.popen.poll() is None


@pytest.mark.slow
def test_a_folder_that_is_moved_goes_on_where_it_lies(processes, live):
    coordinator, folder = live
    folder.rename(processes.runs / "elsewhere")
    said = said_of(coordinator)
    goes_on(processes, coordinator, said, "elsewhere")


@pytest.mark.slow
def test_a_bundle_that_is_removed_is_served_on_and_written_again(processes, live):
    coordinator, folder = live
    (folder / "bundle.zip").unlink()
    coordinator.wait_for_event("bundle written")
    worker = processes.start("worker", "--connect", processes.endpoint, "--slots", "1", "--task", tasks.SLOW_TOY)
    worker.wait_for_event("joined")
    assert coordinator.popen.poll() is None
    assert (folder / "bundle.zip").exists()


@pytest.mark.slow
def test_a_controller_whose_name_is_a_folder_is_a_clear_error(processes, live):
    coordinator, folder = live
    (folder / "controller.npz").unlink(missing_ok=True)
    (folder / "controller.npz").mkdir()
    coordinator.popen.send_signal(signal.SIGTERM)
    assert coordinator.finish()[0] == 1
    assert "controller.npz" in coordinator.lines[-1]
    assert "Traceback" not in "".join(coordinator.lines)
    (folder / "controller.npz").rmdir()
    generations = closed(coordinator)
    again = processes.start(
        "coordinator", "--resume", "test", "--runs-dir", processes.runs, "--generations", generations
    )
    assert again.finish()[0] == 0


@pytest.mark.slow
def test_a_lock_that_is_removed_by_hand_lets_nobody_in(processes, live):
    coordinator, folder = live
    (folder / "lock").unlink()
    code, *_ = processes.call("coordinator", "--resume", "test", "--runs-dir", processes.runs, "--listen",
                                  f"tcp/127.0.0.1:{free_port()}")  # fmt: skip
    assert code != 0
    coordinator.wait_for_event("generation")


@pytest.mark.slow
def test_a_log_that_is_truncated_is_rescued_before_anything_is_written_over_it(processes, live):
    coordinator, folder = live
    os.truncate(folder / "journal.sqlite-wal", 0)
    said = said_of(coordinator)
    goes_on(processes, coordinator, said)


@pytest.mark.slow
def test_a_log_that_a_checkpoint_of_others_empties_is_no_reason_to_leave(processes, live):
    coordinator, folder = live
    with closing(sqlite3.connect(folder / "journal.sqlite", timeout=30)) as other:
        assert other.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchone()[0] == 0
    generations = closed(coordinator)
    coordinator.wait_for_event("generation", times=generations + 2)
    assert coordinator.popen.poll() is None


@pytest.mark.parametrize("kind", ["folder", "other"])
def test_a_controller_that_cannot_be_written_is_not_a_full_disk(kind):
    code = {"folder": errno.EISDIR, "other": errno.EIO}[kind]
    error = write_error("controller.npz", OSError(code, os.strerror(code)))
    assert not isinstance(error, NotWritableNowError)
    assert isinstance(write_error("controller.npz", OSError(errno.ENOSPC, "")), NotWritableNowError)
