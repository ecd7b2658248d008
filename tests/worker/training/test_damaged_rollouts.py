"""Recorded drives damaged in thousands of ways: each is read, or refused in one line."""

import numpy as np
import pytest

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.training.data.collect import import_rollouts
from dreamfleet.worker.training.data.dataset import check_whole, load_arrays, load_pictures, load_steps
from dreamfleet.worker.training.data.rollouts import load_rollouts
from tests.support.drives import write_drive
from tests.support.mutations import Watched, archives

COUNT = 1000


@pytest.fixture
def watched():
    made = Watched()
    yield made
    made.check()


def read(path):
    check_whole([path], "picture", "action")
    assert len(load_pictures(path)) > 0
    assert len(load_steps(path)["reward"]) > 0
    load_arrays(path, "driver")


@pytest.mark.slow
def test_damaged_drives(tmp_path, watched):
    whole = write_drive(tmp_path, 0, steps=3).read_bytes()
    path, count = tmp_path / "d.npz", 0
    for data in archives(whole, COUNT, seed=6):
        path.write_bytes(data)
        count += watched.read(DatasetError, read, path)
    assert 0 < count < COUNT


def test_damaged_encoded_drives(tmp_path, watched):
    path, count = tmp_path / "e.npz", 0
    names = ("mu", "logvar", "mirrored_mu", "mirrored_logvar")
    latents = dict.fromkeys(names, np.zeros((5, 4), np.float32))
    np.savez(path, **latents, action=np.zeros((5, 3), np.float32), reward=np.zeros(5, np.float32), ended=np.array(True))
    for data in archives(path.read_bytes(), COUNT, seed=7):
        path.write_bytes(data)
        count += watched.read(DatasetError, lambda: load_rollouts([path], np.array([True])))
    assert 0 < count < COUNT


@pytest.mark.parametrize(
    "changed",
    [
        {"picture": np.zeros((4, 64, 64, 3), np.float32)},
        {"picture": np.zeros((4, 32, 64, 3), np.uint8)},
        {"picture": np.zeros((), np.uint8)},
        {"picture": np.zeros((5, 64, 64, 3), np.uint8)},
        {"action": np.zeros((4, 3), np.int64)},
        {"action": np.zeros(4, np.float32)},
        {"action": np.zeros((3, 3), np.float32)},
        {"action": np.array([["a"] * 3] * 4)},
        {"reward": np.zeros((4, 1), np.float32)},
        {"reward": np.zeros(0, np.float32)},
        {"ended": np.zeros(4, bool)},
        {"ended": np.array("yes")},
        {"preprocessing": np.zeros(3)},
    ],
)
def test_a_drive_of_another_kind_is_never_taken_in(tmp_path, changed):
    path = write_drive(tmp_path / "sent", 0, steps=4)
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **{**arrays, **changed})
    with pytest.raises(DatasetError):
        list(import_rollouts(tmp_path / "data", [path]))
    assert not list((tmp_path / "data").rglob("*.npz"))
