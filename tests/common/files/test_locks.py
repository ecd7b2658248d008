"""A lock file is a regular file whose content stays; anything else is refused in one line, at once.
Tests common/runs/run_lock.py."""

import os

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.locks import folder_lock
from dreamfleet.common.runs.run_lock import is_run_locked, run_lock
from dreamfleet.coordinator.addons.runs import backup
from dreamfleet.coordinator.addons.spawn.agent import Channel, FailedError, HostFolder

LOCKS = {
    "folder": (lambda folder: folder_lock(folder / "lock", "`dreamfleet access`"), "lock"),
    "run": (run_lock, "lock"),
    "agent": (lambda folder: HostFolder(str(folder), Channel()).locked(), "lock"),
    "backup": (lambda folder: backup._backup_lock(folder / "night"), ".night.lock"),
}


@pytest.fixture(params=LOCKS)
def locked(request):
    return LOCKS[request.param]


def test_a_link_is_not_followed(tmp_path, locked):
    hold, name = locked
    own, folder = tmp_path / "own", tmp_path / "folder"
    own.write_text("mine")
    folder.mkdir()
    (folder / name).symlink_to(own)
    with pytest.raises((UsageError, FailedError)), hold(folder):
        pass
    assert own.read_text() == "mine"


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_a_pipe_or_a_folder_is_refused_at_once(tmp_path, locked, make):
    hold, name = locked
    make(tmp_path / name)
    with pytest.raises((UsageError, FailedError)), hold(tmp_path):
        pass
    assert not is_run_locked(tmp_path)


def test_what_a_lock_file_holds_stays(tmp_path, locked):
    hold, name = locked
    other = tmp_path / "other"
    other.write_text("mine")
    (tmp_path / name).hardlink_to(other)
    with hold(tmp_path):
        assert other.read_text() == "mine"
