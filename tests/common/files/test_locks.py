"""A lock file is a regular file whose content stays; anything else is refused in one line, at once.
Tests regular_files.py and common/runs/run_lock.py."""

import errno
import os
from io import BufferedReader

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.locks import folder_lock
from dreamfleet.common.files.regular_files import _Readable
from dreamfleet.common.runs.run_lock import is_run_locked, run_lock
from dreamfleet.coordinator.addons.runs import backup
from dreamfleet.coordinator.addons.spawn.agent import CREATED, Channel, FailedError, HostFolder


def lock_of_agent(folder):
    (folder / CREATED).write_text("[]")
    return HostFolder(str(folder), Channel()).locked()


LOCKS = {
    "folder": (lambda folder: folder_lock(folder / "lock", "`dreamfleet access`"), "lock"),
    "run": (run_lock, "lock"),
    "agent": (lock_of_agent, "lock"),
    "backup": (lambda folder: backup._backup_lock(folder / "night"), ".night.lock"),
}


@pytest.mark.parametrize(("hold", "name"), LOCKS.values(), ids=LOCKS)
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda lock: lock.symlink_to(lock.parents[1] / "own")])
def test_a_pipe_a_folder_or_a_link_is_refused_at_once_and_what_a_lock_file_holds_stays(tmp_path, hold, name, make):
    own, lock = tmp_path / "own", tmp_path / "folder" / name
    own.write_text("mine")
    lock.parent.mkdir()
    make(lock)
    with pytest.raises((UsageError, FailedError)), hold(lock.parent):
        pass
    assert not is_run_locked(lock.parent)
    lock.rmdir() if lock.is_dir() else lock.unlink()
    lock.hardlink_to(own)
    with hold(lock.parent):
        assert own.read_text() == "mine"


def test_a_regular_file_that_has_nothing_to_read_yet_is_an_error():
    """As `/proc/kmsg`, which only root may read."""
    read, write = os.pipe2(os.O_NONBLOCK)
    with BufferedReader(_Readable(read)) as file:
        for size in (-1, 10):
            with pytest.raises(OSError, match=str(errno.EINVAL)):
                file.read(size)
    os.close(write)
