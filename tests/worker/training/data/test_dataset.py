import itertools

import numpy as np
import pytest

from dreamfleet.common.errors import DatasetError
from dreamfleet.worker.training.data.dataset import (
    episode_paths,
    load_arrays,
    load_pictures,
    pad,
    picture_batches,
    split_held_out,
)
from tests.support.drives import write_drive, write_drives

NAMES = ("picture", "action", "reward", "preprocessing")


@pytest.mark.parametrize("kind", ["episodes", "encoded"])
def test_an_empty_folder_is_refused_with_the_verb_that_fills_it(tmp_path, kind):
    with pytest.raises(DatasetError, match="collect" if kind == "episodes" else "encode"):
        episode_paths(tmp_path, kind)


def test_one_episode_is_too_few_to_hold_any_out(tmp_path):
    write_drive(tmp_path, 0)
    with pytest.raises(DatasetError):
        episode_paths(tmp_path)


def test_files_of_an_unfinished_write_are_no_episodes(tmp_path):
    paths = write_drives(tmp_path)
    (tmp_path / "episodes" / ".000099.npz.1.part").write_bytes(b"half")
    assert episode_paths(tmp_path) == paths


def test_whole_episodes_are_held_out(tmp_path):
    paths = [tmp_path / f"{number:06d}.npz" for number in range(45)]
    train, held_out = split_held_out(paths)
    assert sorted(train + held_out) == paths
    assert not set(train) & set(held_out)
    assert held_out == [paths[0], paths[20], paths[40]]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_truncated_episode_is_refused(tmp_path, share):
    path = write_drive(tmp_path, 0)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(DatasetError):
        load_arrays(path, *NAMES)


def test_no_damage_to_any_byte_raises_another_kind_of_error(tmp_path):
    path = write_drive(tmp_path, 0, steps=2)
    whole, data = load_arrays(path, *NAMES), path.read_bytes()
    for position in range(0, len(data), 13):
        damaged = bytearray(data)
        damaged[position] ^= 0xFF
        path.write_bytes(damaged)
        try:
            found = load_arrays(path, *NAMES)
        except DatasetError:
            continue
        assert all(np.array_equal(found[name], whole[name]) for name in NAMES), position


@pytest.mark.parametrize(
    "changes",
    [
        {"preprocessing": np.array("bilinear-64")},
        {"picture": np.zeros((4, 96, 96, 3), np.uint8)},
        {"picture": np.zeros((0, 64, 64, 3), np.uint8)},
    ],
)
def test_pictures_of_another_kind_are_refused(tmp_path, changes):
    path = write_drive(tmp_path, 0)
    np.savez_compressed(path, **{**load_arrays(path, *NAMES), **changes})
    with pytest.raises(DatasetError):
        load_pictures(path)


def test_batches_are_a_pure_function_of_seed_and_pool(tmp_path):
    paths = write_drives(tmp_path)

    def first(seed, pool):
        return next(picture_batches(paths, 16, seed, pool))[-1]

    assert np.array_equal(first(0, 0), first(0, 0))
    assert not np.array_equal(first(0, 0), first(1, 0))
    assert not np.array_equal(first(0, 0), first(0, 1))


def test_a_pool_shows_no_picture_twice(tmp_path):
    paths = write_drives(tmp_path)
    batches = itertools.takewhile(lambda each: each[0] == 0, picture_batches(paths, 16, seed=0))
    pictures = np.concatenate([batch for _, _, batch in batches])
    assert len(np.unique(pictures.reshape(len(pictures), -1), axis=0)) == len(pictures)


def test_batches_go_on_behind_any_of_them(tmp_path):
    paths = write_drives(tmp_path)
    batches = list(itertools.islice(picture_batches(paths, 16, 0), 9))
    for index, (pool, taken, _) in enumerate(batches[:-1]):
        behind = next(picture_batches(paths, 16, 0, pool, taken))
        assert behind[:2] == batches[index + 1][:2]
        assert np.array_equal(behind[2], batches[index + 1][2])


def test_fewer_pictures_than_a_batch_make_a_smaller_batch(tmp_path):
    paths = write_drives(tmp_path, episodes=2, steps=3)
    assert [len(batch) for _, _, batch in itertools.islice(picture_batches(paths, 100, seed=0), 2)] == [5, 5]


def test_memory_holds_a_pool_and_not_the_data_set(tmp_path, monkeypatch):
    monkeypatch.setattr("dreamfleet.worker.training.data.dataset.POOL_EPISODES", 2)
    loaded = []
    monkeypatch.setattr(
        "dreamfleet.worker.training.data.dataset.load_pictures", lambda path: loaded.append(path) or load_pictures(path)
    )
    next(picture_batches(write_drives(tmp_path), 4, seed=0))
    assert len(loaded) == 2


def test_padding_is_zero_behind_the_end():
    padded = pad([np.ones((2, 3), np.float32), np.ones((4, 3), np.float32)])
    assert padded.shape == (2, 4, 3)
    assert padded.sum(axis=(1, 2)).tolist() == [6, 12]
    assert not padded[0, 2:].any()
