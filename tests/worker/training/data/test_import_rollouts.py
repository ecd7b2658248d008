import numpy as np
import pytest

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.training.data.collect import episode_path
from dreamfleet.worker.training.data.dataset import episode_paths
from dreamfleet.worker.training.data.import_rollouts import import_rollouts
from tests.support.drives import write_drive, write_drives

pytestmark = pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")


def test_drives_take_the_next_free_numbers_each_once(tmp_path):
    data, run = tmp_path / "data", tmp_path / "run"
    write_drive(data, 0)
    write_drive(data, 7, steps=10)
    rollouts = [write_drive(run, number, steps=5 + number) for number in (3, 4)]
    assert list(import_rollouts(data, rollouts)) == [8, 9]
    assert [path.name for path in episode_paths(data)] == ["000000.npz", "000007.npz", "000008.npz", "000009.npz"]
    assert episode_path(data, 9).read_bytes() == rollouts[1].read_bytes()
    assert list(import_rollouts(data, rollouts)) == []
    later = write_drive(run, 5)
    assert list(import_rollouts(data, [*rollouts, later, later])) == [12]


def test_an_empty_folder_begins_at_zero(tmp_path):
    assert list(import_rollouts(tmp_path / "data", write_drives(tmp_path / "run", 2))) == [12, 11]
    assert [path.name for path in episode_paths(tmp_path / "data")] == ["000000.npz", "000001.npz"]


def test_what_a_worker_sent_is_looked_at_first(tmp_path):
    drive = write_drive(tmp_path / "run", 0)
    short = {**np.load(drive), "reward": np.zeros(3, np.float32)}
    for content in (b"no drive", None):
        if content is None:
            np.savez_compressed(drive, **short)
        else:
            drive.write_bytes(content)
        with pytest.raises(DatasetError, match=str(drive)):
            list(import_rollouts(tmp_path / "data", [drive]))
        assert not (tmp_path / "data").exists()
