"""A disk that fills up in the middle of a run."""

import os
import re
import shlex
import shutil
import subprocess

import numpy as np
import pytest

from dreamfleet.common.runs.run_folder import open_run
from tests.support import tasks

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root can mount a small disk")

DRIVES = 30
ROOM = 900_000  # bytes: for a while of journal, and not for a drive


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 19 MB, of which the world model's copy takes 14."""
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=19m", "tmpfs", place], check=False).returncode:
        pytest.skip("this host does not let us mount")
    yield place
    subprocess.run(["umount", "--lazy", place], check=True)


def resize(place, size):
    subprocess.run(["mount", "-o", f"remount,size={size}", place], check=True)


@pytest.mark.slow
def test_a_full_disk_is_a_clear_error_and_with_more_room_the_run_goes_on(processes, random_bundle, small_disk):
    flags = ("--task", tasks.TOY, "--population", 64, "--episodes", 1, "--evaluate-every", 0, "--generations", 40)
    processes.runs = small_disk
    full = processes.coordinator("--bundle", random_bundle.path, *flags, name="small")
    processes.worker("--task", tasks.TOY)
    code, _ = full.finish()
    assert code not in (0, 130)
    assert "full" in full.lines[-1]
    with open_run(small_disk, "small") as run:
        before = [(each.number, each.mean) for each in run.history()]
    assert before
    resize(small_disk, 200 << 20)
    again = processes.start(
        "coordinator", "--resume", "small", "--runs-dir", small_disk, "--listen", processes.endpoint,
        "--beat", "0.2", "--generations", 40,
    )  # fmt: skip
    assert again.finish()[0] == 0

    processes.runs = small_disk.parent / "roomy"
    whole = processes.coordinator("--bundle", random_bundle.path, *flags, name="whole")
    processes.worker("--task", tasks.TOY, "--run", "whole")
    assert whole.finish()[0] == 0
    with open_run(small_disk, "small") as one, open_run(processes.runs, "whole") as other:
        history = [(each.number, each.mean) for each in one.history()]
        assert history[: len(before)] == before
        assert history == [(each.number, each.mean) for each in other.history()]


@pytest.mark.slow
def test_a_disk_that_fills_while_a_drive_is_written_keeps_whole_drives_only(processes, random_bundle, small_disk):
    flags = (
        "--task", tasks.HEAVY, "--population", 4, "--episodes", 1, "--evaluate-every", 0, "--generations", 1,
        "--collect-every", 1, "--collect-episodes", DRIVES,
    )  # fmt: skip
    processes.runs = small_disk
    resize(small_disk, 200 << 20)
    full = processes.coordinator("--bundle", random_bundle.path, *flags, name="small")
    processes.worker("--task", tasks.HEAVY, "--run", "small")
    full.wait_for("generation 0: mean")
    resize(small_disk, shutil.disk_usage(small_disk).used + ROOM)
    code, _ = full.finish()
    assert code not in (0, 130)
    assert re.search(r"cannot write .*rollouts/.*: No space left", full.lines[-1])
    assert not list((small_disk / "small" / "rollouts").glob(".*")), "no half of a drive stays"
    resize(small_disk, 200 << 20)
    again = processes.start(
        "coordinator", "--resume", "small", "--runs-dir", small_disk, "--listen", processes.endpoint, "--beat", "0.2",
        "--generations", 1,
    )  # fmt: skip
    assert again.finish()[0] == 0
    with open_run(small_disk, "small") as run:
        assert len(run.rollouts()) == DRIVES
        for path in run.rollouts():
            with np.load(path) as drive:
                assert len(drive["picture"]) == len(drive["action"])


@pytest.mark.slow
def test_a_disk_without_inodes_is_one_line_with_the_command_that_goes_on(processes, random_bundle, small_disk):
    flags = ("--task", tasks.SLOW_TOY, "--population", 4, "--episodes", 1, "--evaluate-every", 0, "--generations", 12)
    processes.runs = small_disk
    full = processes.coordinator("--bundle", random_bundle.path, *flags, name="small")
    processes.worker("--task", tasks.SLOW_TOY, "--exit-when-done")
    full.wait_for("generation 0: mean")
    used = sum(1 for _ in small_disk.rglob("*")) + 1
    subprocess.run(["mount", "-o", f"remount,nr_inodes={used}", small_disk], check=True)
    code, _ = full.finish()
    assert code == 1
    assert "No space left on device; make room; it goes on with: " in full.lines[-1]
    assert not any("Traceback" in line for line in full.lines)
    subprocess.run(["mount", "-o", "remount,nr_inodes=1000", small_disk], check=True)
    again = processes.start("coordinator", *shlex.split(full.lines[-1].split(" coordinator ", 1)[1]))
    assert again.finish()[0] == 0
    with open_run(small_disk, "small") as run:
        assert len(run.history()) == 12
