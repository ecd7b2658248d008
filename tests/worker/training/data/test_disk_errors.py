"""A disk without room names the file that it has none for."""

import errno
import os
from contextlib import contextmanager

import pytest

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.training.data import collect


def test_a_drive_that_a_full_disk_cannot_hold_is_named(monkeypatch, tmp_path):
    @contextmanager
    def full(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        yield path

    monkeypatch.setattr(collect, "atomic_write", full)
    monkeypatch.setattr(collect, "drive_episode", lambda *_: {"action": ()})
    with pytest.raises(DatasetError, match=r"cannot write .*000003\.npz: No space left on device"):
        collect._collect_one((tmp_path, None, 3, ()))
