from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.bundle import find_bundle
from dreamfleet.common.errors import ControllerError, DatasetError, UsageError
from dreamfleet.common.shelf import find_controller
from dreamfleet.worker.car_racing.drivers import DRIVERS
from dreamfleet.worker.training.collect import CollectConfig, collect, drive, episode_path
from dreamfleet.worker.training.dataset import load_pictures
from dreamfleet.worker.training.pilot import Pilot

# SWIG warns as Box2D is imported, and an error there kills the process.
pytestmark = pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")
TINY = CollectConfig(episodes=3, steps=4, seed=5)


@pytest.fixture(autouse=True)
def no_display(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def equal(one, other):
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)


def test_an_episode_is_a_pure_function_of_seed_and_number():
    first = drive(TINY, 1)
    drive(TINY, 2)  # what was driven before leaves no trace
    assert equal(drive(TINY, 1), first)
    assert not equal(drive(CollectConfig(steps=4, seed=6), 1), first)


@pytest.mark.parametrize("anywhere", [0.0, 1.0])
def test_an_episodes_arrays_belong_together(anywhere):
    arrays = drive(CollectConfig(steps=3, anywhere=anywhere), 0)
    assert arrays["picture"].shape == (3, 64, 64, 3)
    assert arrays["picture"].dtype == np.uint8
    assert arrays["action"].shape == (3, 3)
    assert arrays["action"].dtype == arrays["reward"].dtype == np.float32
    assert str(arrays["driver"]) in DRIVERS


def test_an_episode_ends_after_its_patience():
    assert len(drive(CollectConfig(steps=300, anywhere=0.0, patience=5), 0)["reward"]) < 60


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
    "changes", [{"episodes": 0}, {"steps": 0}, {"patience": 0}, {"seed": -1}, {"noise": -1}, {"spells": 1.1}]
)
def test_impossible_settings_are_refused(changes):
    with pytest.raises(UsageError, match=f"--{next(iter(changes))}"):
        CollectConfig(**changes)


def test_a_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(DatasetError, match="choose another --data"):
        list(collect(tmp_path / "file", TINY, jobs=1))


@pytest.mark.parametrize("name", DRIVERS)
def test_a_driver_stays_within_the_cars_controls_and_moves_it(name):
    driver = DRIVERS[name](np.random.default_rng(0))
    actions = np.array([driver.act() for _ in range(2000)])
    assert actions.dtype == np.float32
    assert (actions >= [-1, 0, 0]).all()
    assert (actions <= 1).all()
    assert ((actions[:, 1] > 0) & (actions[:, 2] > 0)).sum() == 0  # one pedal at a time
    assert actions[:, 1].mean() > actions[:, 2].mean()


@pytest.fixture
def pilot(tmp_path):
    return Pilot(find_controller("tiny", tmp_path)[0], find_bundle("tiny"))


def test_controllers_drive_in_turn_under_noise_as_a_function_of_seed_and_number(pilot, tmp_path):
    still = Pilot(replace(pilot.controller, parameters=np.zeros_like(pilot.controller.parameters)), pilot.bundle)
    first = drive(TINY, 1, (pilot, still))
    assert equal(drive(TINY, 1, (pilot, still)), first)
    assert equal(drive(TINY, 1, (still,)), first)
    assert not equal(drive(TINY, 1, (pilot,)), first)
    assert str(first["driver"]) == "controller"
    quiet = drive(replace(TINY, noise=0.0), 1, (still,))
    assert np.ptp(quiet["action"], axis=0).max() == 0 < np.ptp(first["action"], axis=0).max()
    tried = drive(replace(TINY, noise=0.0, spells=1.0), 1, (still,))
    assert np.array_equal(tried["action"][:, 0], quiet["action"][:, 0])
    assert (tried["action"][:, 2] > 0).all()
    assert list(collect(tmp_path, TINY, 1, (pilot, still))) == [4, 4, 4]
    with np.load(episode_path(tmp_path, 1)) as written:
        assert equal(dict(written), first)


def test_a_controller_of_another_model_or_other_pictures_drives_for_no_data_set(pilot, random_bundle, tmp_path):
    with pytest.raises(ControllerError, match=r"is of the world model .*, not of .*random\.zip"):
        list(collect(tmp_path, TINY, 1, (Pilot(pilot.controller, random_bundle),)))
    with pytest.raises(ControllerError, match=r"sees 'box-64' .* holds 'raw-96' .*: choose another --picture"):
        list(collect(tmp_path, replace(TINY, picture=96), 1, (pilot,)))
    assert not (tmp_path / "episodes").exists()
