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


def remove(*names):
    return lambda folder: [(folder / name).unlink() for name in names]


def replace_by_copy(folder):
    shutil.copyfile(folder / "journal.sqlite", folder / "copy")
    (folder / "copy").replace(folder / "journal.sqlite")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("harm", "name"),
    [
        (remove("journal.sqlite"), "test"), (shutil.rmtree, "test-rescued"), (replace_by_copy, "test"),
        (lambda folder: folder.rename(folder.with_name("elsewhere")), "elsewhere"),
        pytest.param(remove("journal.sqlite-wal"), "test", marks=pytest.mark.long),
        pytest.param(remove(*(f"journal.sqlite{end}" for end in ("", "-wal", "-shm"))), "test", marks=pytest.mark.long),
        pytest.param(lambda folder: os.truncate(folder / "journal.sqlite-wal", 0), "test", marks=pytest.mark.long),
    ],
    ids=["journal", "folder", "another journal", "moved", "log", "journal and log", "truncated log"],
)  # fmt: skip
def test_what_is_lost_is_rescued_and_goes_on_where_the_error_says(processes, live, harm, name):
    coordinator, folder = live
    harm(folder)
    strange = folder / "journal.sqlite"
    kept = strange.read_bytes() if strange.exists() else None
    said = said_of(coordinator)
    if harm is replace_by_copy:
        assert strange.read_bytes() == kept, "what somebody put there stays"
    goes_on(processes, coordinator, said, name)


@pytest.mark.slow
def test_who_reads_the_journal_or_empties_its_log_is_no_reason_to_leave(processes, live):
    coordinator, folder = live
    for checkpoint in ("wal_checkpoint", "wal_checkpoint(TRUNCATE)") * 2:
        with closing(sqlite3.connect(folder / "journal.sqlite", timeout=30)) as reader, reader:
            reader.execute("SELECT count(*) FROM result").fetchone()
            reader.execute(f"PRAGMA {checkpoint}")
    assert processes.call("runs", "show", "test", "--runs-dir", processes.runs)[0] == 0
    coordinator.wait_for_event("generation", times=closed(coordinator) + 2)
    assert coordinator.popen.poll() is None


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
    again = processes.resume("test", "--generations", generations)
    assert again.finish()[0] == 0


@pytest.mark.slow
def test_a_lock_that_is_removed_by_hand_lets_nobody_in(processes, live):
    coordinator, folder = live
    (folder / "lock").unlink()
    code, *_ = processes.call("coordinator", "--resume", "test", "--runs-dir", processes.runs, "--listen",
                                  f"tcp/127.0.0.1:{free_port()}")  # fmt: skip
    assert code != 0
    coordinator.wait_for_event("generation")


@pytest.mark.parametrize("kind", ["folder", "other"])
def test_a_controller_that_cannot_be_written_is_not_a_full_disk(kind):
    code = {"folder": errno.EISDIR, "other": errno.EIO}[kind]
    error = write_error("controller.npz", OSError(code, os.strerror(code)))
    assert not isinstance(error, NotWritableNowError)
    assert isinstance(write_error("controller.npz", OSError(errno.ENOSPC, "")), NotWritableNowError)
