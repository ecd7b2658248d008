"""A live run whose files are removed, replaced or moved: nothing is lost, it says so soon, and it can be continued.

Tests coordinator/storage/file_watch.py, coordinator/storage/served_bundle.py and
coordinator/storage/journal_connection.py.
"""

import os
import shlex
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing

import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks
from tests.support.processes import DEADLINE, environment, free_port, started


@pytest.fixture
def live(processes, small):
    """A run in its third generation, and its folder."""
    coordinator = processes.coordinator(*small)
    processes.worker("--task", tasks.SLOW_TOY)
    coordinator.wait_for_event("generation", number=1)
    return coordinator, processes.runs / "test"


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
    assert coordinator.finish()[0] == 1
    assert "Traceback" not in "".join(coordinator.lines)
    if harm is replace_by_copy:
        assert strange.read_bytes() == kept, "what somebody put there stays"
    reported = [(each["number"], each["mean"]) for each in coordinator.events("generation")]
    said = coordinator.lines[-1]
    command = shlex.split(said[said.index(sys.executable) :])
    command += ["--generations", str(len(reported) + 1), "--listen", processes.endpoint]
    with started(command, stderr=subprocess.PIPE, text=True, env=environment(processes.cache)) as again:
        _, err = again.communicate(timeout=DEADLINE)
        assert again.returncode == 0, err
    with open_run(processes.runs, name) as run:
        history = [(each.number, each.mean) for each in run.history()]
    assert (history[:-1], len(history)) == (reported, len(reported) + 1)


@pytest.mark.slow
def test_who_reads_the_journal_or_empties_its_log_is_no_reason_to_leave(processes, live):
    coordinator, folder = live
    for checkpoint in ("wal_checkpoint", "wal_checkpoint(TRUNCATE)") * 2:
        with closing(sqlite3.connect(folder / "journal.sqlite", timeout=30)) as reader, reader:
            reader.execute("SELECT count(*) FROM result").fetchone()
            reader.execute(f"PRAGMA {checkpoint}")
    assert processes.call("runs", "show", "test", "--runs-dir", processes.runs)[0] == 0
    coordinator.wait_for_event("generation", times=len(coordinator.events("generation")) + 2)
    assert coordinator.popen.poll() is None


@pytest.mark.slow
def test_a_bundle_that_is_removed_is_served_on_and_written_again(processes, live):
    coordinator, folder = live
    (folder / "bundle.zip").unlink()
    coordinator.wait_for_event("bundle written")
    processes.worker("--task", tasks.SLOW_TOY).wait_for_event("joined")
    assert coordinator.popen.poll() is None
    assert (folder / "bundle.zip").exists()


@pytest.mark.slow
def test_a_controller_whose_name_is_a_folder_is_a_clear_error(processes, live):
    coordinator, folder = live
    (folder / "controller.npz").unlink(missing_ok=True)
    (folder / "controller.npz").mkdir()
    assert coordinator.stop()[0] == 1
    assert "controller.npz" in coordinator.lines[-1]
    assert "Traceback" not in "".join(coordinator.lines)
    (folder / "controller.npz").rmdir()
    again = processes.resume("test", "--generations", len(coordinator.events("generation")))
    assert again.finish()[0] == 0


@pytest.mark.slow
def test_a_lock_that_is_removed_by_hand_lets_nobody_in(processes, live):
    coordinator, folder = live
    (folder / "lock").unlink()
    assert processes.resume("test", "--listen", f"tcp/127.0.0.1:{free_port()}").finish()[0] != 0
    coordinator.wait_for_event("generation")
