"""Locks of file systems, and files that are written whole. Tests atomic_write.py."""

import errno
import os
import re
import shutil
import sqlite3
import sys
import tempfile
from contextlib import contextmanager, suppress
from pathlib import Path
from unittest.mock import Mock

import pytest

from dreamfleet.common.errors import DreamfleetError, JournalError, UsageError
from dreamfleet.common.files.atomic_write import check_output_path, open_output
from dreamfleet.common.files.file_system import LEAST_ROOM, disk_problem, file_system_type, is_network, lock_problem
from dreamfleet.common.runs.journal import schema
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import JOURNAL
from dreamfleet.coordinator.storage.journal import Journal
from tests.support.no_locks import UNAVAILABLE
from tests.support.processes import ROOT
from tests.support.tables import cells

LIST = """\
22 1 8:1 / / rw,relatime shared:1 - ext4 /dev/sda1 rw
30 22 0:40 / /home rw,relatime shared:2 - nfs4 filer:/home rw,vers=4.2
31 30 8:2 / /home/me/fast\\040disk rw - xfs /dev/sdb1 rw
32 22 0:41 / /mnt/box rw - fuse.sshfs me@box: rw
33 22 0:42 / /mnt/lake rw - lustre mds@tcp:/lake rw
34 22 8:3 / /mnt/stick rw - fuseblk /dev/sdc1 rw
35 22 0:43 / /mnt/box/over rw - tmpfs none rw
36 35 0:44 / /mnt/box/over rw - cifs //box/over rw
broken line
"""


TYPES = {
    "/somewhere": "ext4", "/home": "nfs4", "/home/me/runs": "nfs4", "/homer": "ext4", "/home/me/fast disk/runs": "xfs",
    "/mnt/box/runs": "fuse.sshfs", "/mnt/lake": "lustre", "/mnt/stick": "fuseblk", "/mnt/box/over/x": "cifs",
}  # fmt: skip


def test_the_longest_and_last_mount_says_the_type(tmp_path):
    mounts = tmp_path / "mountinfo"
    mounts.write_text(LIST)
    assert {path: file_system_type(Path(path), mounts) for path in TYPES} == TYPES
    assert {found for found in TYPES.values() if is_network(found)} == {"nfs4", "fuse.sshfs", "lustre", "cifs"}
    assert not is_network(file_system_type(tmp_path, tmp_path / "none")), "without a list"


def test_locks_work_here_and_the_trial_leaves_nothing(tmp_path):
    assert lock_problem(tmp_path / "runs" / "night") == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("free", [0, LEAST_ROOM])
def test_an_error_for_want_of_room_names_the_full_disk(tmp_path, monkeypatch, free):
    shutil.copytree(ROOT / "tests" / "fixtures" / "runs" / "dream", tmp_path / "night")
    error = sqlite3.OperationalError("disk I/O error")
    error.sqlite_errorcode = sqlite3.SQLITE_IOERR_SHMSIZE
    monkeypatch.setattr(schema, "check_schema", Mock(side_effect=error))
    monkeypatch.setattr(shutil, "disk_usage", Mock(return_value=Mock(free=free)))
    problem = disk_problem(tmp_path)
    assert bool(problem) == (free < LEAST_ROOM)
    for opened in (RunFolder, lambda folder: Journal(folder / JOURNAL)):
        with pytest.raises(JournalError) as said:
            opened(tmp_path / "night")
        assert str(said.value).endswith(problem)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "said"), [(errno.ENOLCK, "database is locked"), (errno.EOPNOTSUPP, "disk I/O error")]
)
def test_where_locks_fail_the_cause_and_the_remedy_are_named(processes, error, said):
    """`ENOLCK`: NFS without its lock daemon; `EOPNOTSUPP`: a FUSE file system without locks."""
    broken = (sys.executable, "-m", "tests.support.no_locks", str(error))
    refused = processes.start("coordinator", "--run", "new", "--runs-dir", processes.runs, inside=broken)
    code, _ = refused.finish()
    if code == UNAVAILABLE:
        pytest.skip("no seccomp filter here")
    text = "".join(refused.lines)
    assert code == 1
    assert said in text
    assert "--runs-dir" in text
    assert not (processes.runs / "new").exists()
    begun = processes.coordinator("--generations", 1)
    shown = processes.start("runs", "show", "test", "--runs-dir", processes.runs, inside=broken)
    assert shown.finish()[0] == 1
    assert re.search(f"{said}.* {processes.runs / 'test'}", "".join(shown.lines))
    doctor = processes.start("doctor", "--runs-dir", processes.runs, inside=broken)
    code, out = doctor.finish()
    found = {tuple(row[:2]): row[2] for row in map(cells, out.splitlines()) if len(row) > 2}
    assert code == 1
    assert str(processes.runs) in found["failed", "runs folder"]
    begun.end()


NOBODY = 65534


def test_an_impossible_path_is_an_error_before_the_work_and_devices_and_pipes_are_not_replaced(tmp_path):
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file" / "tiny.json", pipe, link):
        with pytest.raises(UsageError, match="--out"):
            check_output_path(path)
        with pytest.raises(DreamfleetError, match=re.escape(str(path))), open_output(path):
            pass
    assert pipe.is_fifo()
    assert link.is_symlink()


@contextmanager
def without_root():
    """Root may write anywhere, so a test that needs a refusal gives up root's rights for a moment."""
    user = os.getuid()
    os.setresuid(NOBODY if user == 0 else user, NOBODY if user == 0 else user, user)
    try:
        yield
    finally:
        os.setresuid(user, user, user)


def test_a_read_only_folder_is_reported_before_the_work():
    with tempfile.TemporaryDirectory() as name:  # not tmp_path, which another user may not enter
        folder = Path(name)
        folder.chmod(0o777)
        with without_root():
            check_output_path(folder / "tiny.json")
        folder.chmod(0o555)
        with without_root(), pytest.raises(UsageError, match="--out"):
            check_output_path(folder / "tiny.json")


def test_the_folder_is_created_the_file_is_complete_and_a_failed_write_leaves_the_old_one(tmp_path):
    path = tmp_path / "results" / "tiny.json"
    check_output_path(path)
    with open_output(path) as file:
        file.write(b"before")
    with suppress(RuntimeError), open_output(path) as file:
        file.write(b"half")
        raise RuntimeError
    assert list(path.parent.iterdir()) == [path]
    assert path.read_text() == "before"
    with pytest.raises(DreamfleetError, match="n" * 300), open_output(tmp_path / ("n" * 300)):
        pass
