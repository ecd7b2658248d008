"""A disk that fills up in the middle of a run."""

import os
import shutil
import sqlite3
import subprocess
import time
from contextlib import closing

import numpy as np
import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks

DRIVES = 30
FILE_CHECK = 1.0  # seconds between two looks at the files
ROOM = 900_000  # bytes: for a while of journal, and not for a drive


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 19 MB, of which the world model's copy takes 14."""
    if os.geteuid() != 0:
        pytest.skip("only root can mount a small disk")
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=19m", "tmpfs", place], check=False).returncode:
        pytest.skip("this host does not let us mount")
    yield place
    subprocess.run(["umount", "--lazy", place], check=True)


def resize(place, size):
    subprocess.run(["mount", "-o", f"remount,size={size}", place], check=True)


@pytest.mark.slow
def test_a_run_on_a_full_disk_waits_and_goes_on_by_itself_to_the_same_bits(processes, random_bundle, small_disk):
    flags = ("--task", tasks.TOY, "--population", 64, "--episodes", 1, "--evaluate-every", 0, "--generations", 40)
    processes.runs = small_disk
    full = processes.coordinator("--bundle", random_bundle.path, *flags, name="small")
    processes.worker("--task", tasks.TOY, "--run", "small")
    full.wait_for_event("paused")
    status = processes.status()
    assert status["state"] == "paused"
    assert 0 < status["generations"] < 40
    resize(small_disk, 200 << 20)
    full.wait_for_event("written")
    assert full.finish()[0] == 0

    processes.runs = small_disk.parent / "roomy"
    whole = processes.coordinator("--bundle", random_bundle.path, *flags, name="whole")
    processes.worker("--task", tasks.TOY, "--run", "whole")
    assert whole.finish()[0] == 0
    with open_run(small_disk, "small") as one, open_run(processes.runs, "whole") as other:
        history = [(each.number, each.mean) for each in one.history()]
        assert history == [(each.number, each.mean) for each in other.history()]


@pytest.mark.slow
def test_a_run_whose_journal_is_locked_waits_and_goes_on(processes, random_bundle):
    flags = ("--task", tasks.SLOW_TOY, "--population", 4, "--episodes", 1, "--evaluate-every", 0, "--generations", 12)
    locked = processes.coordinator("--bundle", random_bundle.path, *flags)
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
    with open_run(processes.runs, "test") as run:
        assert len(run.history()) == 12


@pytest.mark.slow
def test_a_coordinator_that_is_killed_while_it_waits_for_room_loses_nothing(processes, random_bundle, small_disk):
    flags = ("--task", tasks.TOY, "--population", 64, "--episodes", 1, "--evaluate-every", 0, "--generations", 40)
    processes.runs = small_disk
    full = processes.coordinator("--bundle", random_bundle.path, *flags, name="small")
    processes.worker("--task", tasks.TOY, "--run", "small")
    full.wait_for_event("paused")
    full.end()
    resize(small_disk, 200 << 20)
    again = processes.start(
        "coordinator", "--resume", "small", "--runs-dir", small_disk, "--listen", processes.endpoint,
        "--beat", "0.2", "--generations", 40,
    )  # fmt: skip
    assert again.finish()[0] == 0
    with open_run(small_disk, "small") as run:
        assert len(run.history()) == 40


@pytest.mark.slow
def test_a_disk_that_fills_while_a_drive_is_written_keeps_every_drive_whole(processes, random_bundle, small_disk):
    flags = (
        "--task", tasks.HEAVY, "--population", 4, "--episodes", 1, "--evaluate-every", 0, "--generations", 1,
        "--collect-every", 1, "--collect-episodes", DRIVES,
    )  # fmt: skip
    processes.runs = small_disk
    resize(small_disk, 200 << 20)
    full = processes.coordinator("--bundle", random_bundle.path, *flags, name="small")
    processes.worker("--task", tasks.HEAVY, "--run", "small")
    full.wait_for_event("generation", number=0)
    resize(small_disk, shutil.disk_usage(small_disk).used + ROOM)
    full.wait_for_event("paused")
    assert not list((small_disk / "small" / "rollouts").glob(".*")), "no half of a drive stays"
    resize(small_disk, 200 << 20)
    assert full.finish()[0] == 0
    with open_run(small_disk, "small") as run:
        assert len(run.rollouts()) == DRIVES
        for path in run.rollouts():
            with np.load(path) as drive:
                assert len(drive["picture"]) == len(drive["action"])


@pytest.mark.long
def test_a_run_on_a_disk_without_inodes_waits_and_goes_on_by_itself(processes, random_bundle, small_disk):
    flags = ("--task", tasks.SLOW_TOY, "--population", 4, "--episodes", 1, "--evaluate-every", 0, "--generations", 12)
    processes.runs = small_disk
    resize(small_disk, "40m")  # room for the write-ahead log: only inodes are short
    full = processes.coordinator("--bundle", random_bundle.path, *flags, name="small")
    processes.worker("--task", tasks.SLOW_TOY)
    full.wait_for_event("generation", number=0)
    used = sum(1 for _ in small_disk.rglob("*")) + 1
    subprocess.run(["mount", "-o", f"remount,nr_inodes={used}", small_disk], check=True)
    full.wait_for_event("paused")
    subprocess.run(["mount", "-o", "remount,nr_inodes=1000", small_disk], check=True)
    full.wait_for_event("written")
    assert full.finish()[0] == 0
    with open_run(small_disk, "small") as run:
        assert len(run.history()) == 12
