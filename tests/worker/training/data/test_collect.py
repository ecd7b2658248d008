"""Collecting rollouts: driven here, or imported from a run; a full disk and damaged rollouts name their files.

Tests collect_config.py, pilot.py, worker/worlds/car_racing/drivers.py and
worker/worlds/car_racing/random_network.py.
"""

import errno
import os
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.errors import ControllerError, DatasetError, DreamfleetError, UsageError
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.worker.scoring.rollout import DataWorld
from dreamfleet.worker.training.data import collect as module
from dreamfleet.worker.training.data.collect import collect, drive_episode, import_rollouts
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.dataset import episode_path, episode_paths, load_pictures, load_steps
from dreamfleet.worker.training.data.pilot import Pilot
from dreamfleet.worker.worlds.car_racing.drivers import DRIVERS, PushedDriver, UniformDriver
from dreamfleet.worker.worlds.car_racing.random_network import RandomNetworkPolicy
from tests.support import pixel_fakes
from tests.support.drives import write_drive

TINY = CollectConfig(episodes=3, steps=4, seed=5)


def equal(one, other):
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def test_an_episode_ends_after_its_patience():
    assert len(drive_episode(CollectConfig(steps=300, anywhere=0.0, patience=5), 0)["reward"]) < 60
    assert len(drive_episode(CollectConfig(steps=200, anywhere=0.0, patience=0), 0)["reward"]) == 200


def test_collecting_again_writes_only_what_is_missing_and_the_same(tmp_path):
    assert sorted(collect(tmp_path, TINY, jobs=2)) == [4, 4, 4]
    before = {number: episode_path(tmp_path, number).read_bytes() for number in range(3)}
    kept = episode_path(tmp_path, 0).stat().st_mtime_ns
    episode_path(tmp_path, 1).unlink()
    assert list(collect(tmp_path, TINY, jobs=1)) == [4]
    assert {number: episode_path(tmp_path, number).read_bytes() for number in range(3)} == before
    assert episode_path(tmp_path, 0).stat().st_mtime_ns == kept
    assert list(collect(tmp_path, TINY, jobs=2)) == []
    assert len(load_pictures(episode_path(tmp_path, 2))) == 4


@pytest.mark.parametrize(
    "changes",
    [{"episodes": 0}, {"steps": 0}, {"patience": -1}, {"anywhere": 2}, {"seed": -1}, {"noise": -1}, {"spells": 1.1}],
)
def test_impossible_settings_are_refused(changes):
    with pytest.raises(UsageError, match=f"--{next(iter(changes))}"):
        CollectConfig(**changes)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(DatasetError, match="--data"):
        list(collect(tmp_path / "file", TINY, jobs=1))


@pytest.mark.parametrize("name", DRIVERS)
def test_a_driver_stays_within_the_cars_controls_and_moves_it(name):
    driver = DRIVERS[name](np.random.default_rng(0))
    actions = np.array([driver.act() for _ in range(2000)])
    assert actions.dtype == np.float32
    assert ((actions >= [-1, 0, 0]) & (actions <= 1)).all()
    assert ((actions[:, 1] > 0) & (actions[:, 2] > 0)).sum() == 0  # one pedal at a time
    assert actions[:, 1].mean() > actions[:, 2].mean()


@pytest.mark.parametrize("name", [*DRIVERS, "network"])
def test_a_named_driver_drives_as_a_function_of_seed_and_number(name):
    config = replace(TINY, driver=name, anywhere=0.0, patience=0)
    first, second = (drive_episode(config, number) for number in (1, 2))
    assert equal(drive_episode(config, 1), first)
    assert not np.array_equal(second["action"], first["action"]) or name == "pushed"
    assert str(first["driver"]) == name
    assert ((first["action"] >= [-1, 0, 0]) & (first["action"] <= 1)).all()


def held(driver, steps):
    """The actions that it holds for 20 frames each."""
    actions = np.array([driver.act() for _ in range(steps)]).reshape(-1, 20, 3)
    assert (actions == actions[:, :1]).all()
    return actions[:, 0]


def test_the_notebooks_driver_holds_a_uniform_action_for_20_frames():
    actions = held(UniformDriver(np.random.default_rng(0)), 20_000)
    np.testing.assert_allclose(actions.mean(axis=0), [0, 0.5, 0.5], atol=0.05)
    np.testing.assert_allclose(actions.std(axis=0), np.array([2, 1, 1]) / np.sqrt(12), atol=0.03)


def test_the_articles_driver_pushes_first_and_then_moves_one_control_at_a_time():
    push, *later = held(PushedDriver(np.random.default_rng(0)), 40_000)
    np.testing.assert_allclose(push, [-0.1, 1, 0], atol=1e-6)
    kinds = np.array([(each[0] < 0, each[0] > 0, each[1] > 0, each[2] > 0) for each in later])
    assert (kinds.sum(axis=1) <= 1).all()
    np.testing.assert_allclose(kinds.mean(axis=0), [0.2, 0.2, 0.4, 0.1], atol=0.04)


@pytest.mark.slow
@pytest.mark.parametrize("side", [64, 96])
def test_the_network_looks_at_pictures_and_each_drive_has_its_own(side):
    pictures = np.random.default_rng(0).integers(0, 256, (2, side, side, 3), dtype=np.uint8)
    drivers = [RandomNetworkPolicy(np.random.default_rng(seed)) for seed in range(6)]
    actions = np.array([[driver.act(pictures[step % 2]) for step in range(8)] for driver in drivers])
    assert actions.shape == (6, 8, 3)
    assert np.isfinite(actions).all()
    assert len(np.unique(actions[:, -1], axis=0)) > 2
    blind = RandomNetworkPolicy(np.random.default_rng(1))
    assert any(not np.array_equal(blind.act(255 - pictures[step % 2]), actions[1, step]) for step in range(8))


@pytest.fixture
def pilot(tmp_path):
    return Pilot(find_controller("tiny", tmp_path)[0], find_bundle("tiny"))


def test_controllers_drive_in_turn_under_noise_as_a_function_of_seed_and_number(pilot, tmp_path):
    still = Pilot(replace(pilot.controller, parameters=np.zeros_like(pilot.controller.parameters)), pilot.bundle)
    first = drive_episode(TINY, 1, (pilot, still))
    assert equal(drive_episode(TINY, 1, (pilot, still)), first)
    assert equal(drive_episode(TINY, 1, (still,)), first)
    assert not equal(drive_episode(TINY, 1, (pilot,)), first)
    assert str(first["driver"]) == "controller"
    quiet = drive_episode(replace(TINY, noise=0.0), 1, (still,))
    assert np.ptp(quiet["action"], axis=0).max() == 0 < np.ptp(first["action"], axis=0).max()
    tried = drive_episode(replace(TINY, noise=0.0, spells=1.0), 1, (still,))
    assert np.array_equal(tried["action"][:, 0], quiet["action"][:, 0])
    assert (tried["action"][:, 2] > 0).all()
    assert list(collect(tmp_path, TINY, 1, (pilot, still))) == [4, 4, 4]
    with np.load(episode_path(tmp_path, 1)) as written:
        assert equal(dict(written), first)


def test_a_controller_of_another_model_or_other_pictures_drives_for_no_data_set(pilot, random_bundle, tmp_path):
    with pytest.raises(ControllerError, match=r"random\.zip"):
        list(collect(tmp_path, TINY, 1, (Pilot(pilot.controller, random_bundle),)))
    with pytest.raises(ControllerError, match=r"'box-64'.*'raw-96'.*--picture"):
        list(collect(tmp_path, replace(TINY, picture=96), 1, (pilot,)))
    assert not (tmp_path / "episodes").exists()


def faulty(fault):
    return DataWorld(f"gym:{pixel_fakes.MODULE}:Faulty-v0", f'{{"environment": {{"fault": "{fault}"}}}}')


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("raises", "0.*RuntimeError: a broken simulator$"),
        ("exits", "0.*SystemExit: 0"),
        ("nan", "nan"),
        ("-inf", "-inf"),
        ("1e39", r"1e\+39"),
    ],
)
def test_a_fault_of_the_environment_is_one_line_and_writes_no_drive(fault, named, tmp_path):
    config = CollectConfig(episodes=1, steps=9, anywhere=0.0)
    with pytest.raises(DreamfleetError, match=named):
        module._collect_one(tmp_path, config, (), faulty(fault), 0)
    assert not list(tmp_path.rglob("*.npz"))


@pytest.mark.slow
def test_an_environment_that_hangs_is_given_up(tmp_path):
    config = CollectConfig(episodes=1, steps=9, anywhere=0.0)
    with pytest.raises(DreamfleetError):
        list(collect(tmp_path, config, 1, world=faulty("hangs"), stall=0.5))


def test_a_drive_with_a_reward_that_is_no_number_is_damaged(tmp_path):
    with pytest.raises(DatasetError):
        load_steps(write_drive(tmp_path, 0, steps=3, reward=np.array([0, np.nan, 0], np.float32)))


def test_a_drive_that_a_full_disk_cannot_hold_is_named(monkeypatch, tmp_path):
    @contextmanager
    def full(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        yield path

    monkeypatch.setattr(module, "atomic_write", full)
    monkeypatch.setattr(module, "drive_episode", lambda *_: {"action": ()})
    with pytest.raises(DatasetError, match=r"000003\.npz"):
        module._collect_one(tmp_path, None, (), None, 3)


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
    assert list(import_rollouts(tmp_path / "new", rollouts)) == [8, 9]
    assert [path.name for path in episode_paths(tmp_path / "new")] == ["000000.npz", "000001.npz"]
