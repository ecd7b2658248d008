"""A disk that fills up in the middle of a run.

Tests coordinator/jobs/rollout_collection.py, coordinator/run/run.py, coordinator/storage/journal_connection.py and
coordinator/storage/journal_file.py.
"""

import shutil
import sqlite3
import subprocess
import time
from contextlib import closing

import numpy as np
import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support import disks, tasks
from tests.support.same_bits import evolve

DRIVES, GENERATIONS = 30, 40
FILE_CHECK = 1.0  # seconds between two looks at the files
ROOM = 900_000  # bytes: for a while of journal, and not for a drive


@pytest.fixture
def small_disk(processes):
    """The run's folder as a file system of 8 MB."""
    roomy = processes.runs
    with disks.small_disk(roomy.with_name("disk"), 8) as disk:
        if disk is None:
            pytest.skip("mounting a small disk needs root")
        processes.runs = disk.path
        yield disk.path
        processes.runs = roomy


def remount(place, option):
    subprocess.run(["mount", "-o", f"remount,{option}", place], check=True)


@pytest.fixture
def fast(small):
    return (*small, "--task", tasks.TOY, "--population", 64, "--generations", GENERATIONS)


def history(folder):
    with open_run(folder, "test") as run:
        return [(each.number, each.mean) for each in run.history()]


@pytest.mark.slow
def test_a_run_on_a_full_disk_waits_and_goes_on_by_itself_to_the_same_bits(processes, fast, small_disk):
    full = processes.coordinator(*fast)
    worker = processes.worker("--task", tasks.TOY)
    full.wait_for_event("paused")
    status = processes.status()
    assert status["state"] == "paused"
    assert 0 < status["generations"] < GENERATIONS
    remount(small_disk, "size=200m")
    full.wait_for_event("written")
    assert full.finish()[0] == 0
    worker.end()
    found = history(small_disk)
    processes.runs = processes.folder / "roomy"
    evolve(processes, "test", 1, *fast, task=tasks.TOY)
    assert found == history(processes.runs)


@pytest.mark.slow
def test_a_run_whose_journal_is_locked_waits_and_goes_on(processes, small):
    locked = processes.coordinator(*small, "--generations", 6)
    processes.worker("--task", tasks.SLOW_TOY)
    locked.wait_for_event("generation", number=0)
    with closing(sqlite3.connect(processes.runs / "test" / "journal.sqlite", timeout=60)) as other:
        other.execute("BEGIN IMMEDIATE")
        locked.wait_for_event("paused")
        assert processes.call("resume", "test", "--connect", processes.endpoint)[0] == 1
        time.sleep(7 * FILE_CHECK)  # one wait for the lock, 5 s, and then it looks whether its files are still there
        assert locked.popen.poll() is None, "".join(locked.lines)
        other.rollback()
    locked.wait_for_event("written")
    assert locked.finish()[0] == 0
    assert not locked.events("clock")
    assert len(history(processes.runs)) == 6


@pytest.mark.slow
def test_a_coordinator_that_is_killed_while_it_waits_for_room_loses_nothing(processes, fast, small_disk):
    full = processes.coordinator(*fast)
    processes.worker("--task", tasks.TOY)
    full.wait_for_event("paused")
    full.end()
    remount(small_disk, "size=200m")
    assert processes.resume().finish()[0] == 0
    assert len(history(small_disk)) == GENERATIONS


@pytest.mark.slow
def test_a_disk_that_fills_while_a_drive_is_written_keeps_every_drive_whole(processes, small, small_disk):
    remount(small_disk, "size=200m")
    collected = ("--collect-every", 1, "--collect-episodes", DRIVES)
    full = processes.coordinator(*small, "--task", tasks.HEAVY, "--generations", 1, *collected)
    processes.worker("--task", tasks.HEAVY)
    full.wait_for_event("generation", number=0)
    remount(small_disk, f"size={shutil.disk_usage(small_disk).used + ROOM}")
    full.wait_for_event("paused")
    assert not list((small_disk / "test" / "rollouts").glob(".*")), "no half of a drive stays"
    remount(small_disk, "size=200m")
    assert full.finish()[0] == 0
    with open_run(small_disk, "test") as run:
        assert len(run.rollouts()) == DRIVES
        for path in run.rollouts():
            with np.load(path) as drive:
                assert len(drive["picture"]) == len(drive["action"])


@pytest.mark.long
def test_a_run_on_a_disk_without_inodes_waits_and_goes_on_by_itself(processes, small, small_disk):
    remount(small_disk, "size=40m")  # room for the write-ahead log: only inodes are short
    full = processes.coordinator(*small, "--generations", 12)
    processes.worker("--task", tasks.SLOW_TOY)
    full.wait_for_event("generation", number=0)
    used = sum(1 for _ in small_disk.rglob("*")) + 1
    remount(small_disk, f"nr_inodes={used}")
    full.wait_for_event("paused")
    remount(small_disk, "nr_inodes=1000")
    full.wait_for_event("written")
    assert full.finish()[0] == 0
    assert len(history(small_disk)) == 12
