"""Collecting rollouts: driven here, or imported from a run; a full disk and damaged rollouts name their files.

The world of a data set: how it is named, and that two never mix.
Tests collect_config.py, data_folder.py, pilot.py, common/cli/world_flags.py, worker/worlds/car_racing/drivers.py and
worker/worlds/car_racing/random_network.py.
"""

import errno
import json
import os
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.world_facts import EndRule, RewardFacts
from dreamfleet.common.errors import ControllerError, DatasetError, DreamfleetError, UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.lookup import find_controller
from dreamfleet.worker.scoring.rollout import OF_FIRST_WORLD, DataWorld, write_episode
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.training.data import collect as module
from dreamfleet.worker.training.data.collect import collect, drive_episode, import_rollouts, kept_environment
from dreamfleet.worker.training.data.collect_config import CollectConfig
from dreamfleet.worker.training.data.data_folder import load_preset, resolve_preset, resolve_world, store_preset
from dreamfleet.worker.training.data.dataset import (
    check_pictures,
    episode_path,
    episode_paths,
    existing_episodes,
    find_own_world,
    find_world,
    load_arrays,
    load_pictures,
    load_steps,
    pad,
    preprocessing_of_size,
    world_of_episode,
    world_of_folder,
)
from dreamfleet.worker.training.data.pilot import Pilot
from dreamfleet.worker.training.data.rollout_batches import load_rollouts
from dreamfleet.worker.verbs import collect as verb
from dreamfleet.worker.worlds.car_racing.drivers import DRIVERS, PushedDriver, UniformDriver
from dreamfleet.worker.worlds.car_racing.random_network import RandomNetworkPolicy
from tests.support import pixel_fakes
from tests.support.bundles import write_world_bundle
from tests.support.drives import write_drive
from tests.support.pixel_world import DODGE, DODGE_TASK, Dodge, DodgeTask
from tests.support.verbs import run_verb

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


TASK, GYM = DataWorld(DODGE_TASK), DataWorld(DODGE)
LIMITED = DataWorld(DODGE, '{"environment": {"max_episode_steps": 5}}')
CART = DataWorld("gym:CartPole-v1", '{"observation": "render", "skip": 2}')
PLAIN = CollectConfig(episodes=3, steps=60, seed=5, anywhere=0.0, patience=0)


def call(*words):
    return run_verb(verb, *words, "--jobs", 1)


def write(folder, number, arrays):
    path = episode_path(folder, number)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        write_episode(file, arrays)
    return path


def drive_equal(first, second):
    return all(np.array_equal(first[name], second[name]) for name in first | second)


@pytest.mark.parametrize("world", [OF_FIRST_WORLD, TASK, GYM])
def test_a_drive_in_any_world_is_a_function_of_seed_and_number_and_says_its_world(world, tmp_path):
    config = CollectConfig(steps=4, seed=5, anywhere=0.0)
    first = drive_episode(config, 1, world=world)
    drive_episode(config, 2, world=world)  # leaves no trace
    assert drive_equal(first, drive_episode(config, 1, world=world))
    assert not drive_equal(first, drive_episode(replace(config, seed=6), 1, world=world))
    path = write(tmp_path, 0, first)
    assert load_pictures(path).shape == (4, 64, 64, 3)
    assert load_steps(path)["action"].shape == (4, 3)
    assert str(first["driver"]) in find_world(*world).drivers
    assert world_of_episode(path) == world_of_folder(tmp_path) == find_own_world(tmp_path) == world
    assert str(first["world"]) == world.text


def test_a_process_keeps_its_environment_until_a_drive_fails(monkeypatch):
    monkeypatch.setattr(module, "_kept", None)
    task, name = find_world(*GYM), preprocessing_of_size(64, GYM).name
    with kept_environment(task, name) as first, kept_environment(task, name) as second:
        assert second is first
    closed = []
    monkeypatch.setattr(type(first.unwrapped), "close", lambda _self: closed.append(1))
    with pytest.raises(ValueError, match="a simulator fails"), kept_environment(task, name):
        raise ValueError("a simulator fails")
    assert closed == [1]
    with kept_environment(task, name) as third:
        assert third is not first
    kept = drive_episode(PLAIN, 1, world=GYM, environment_for=kept_environment)
    assert drive_equal(kept, drive_episode(PLAIN, 1, world=GYM))


def test_a_death_is_told_from_a_limit(tmp_path):
    ways = (PLAIN, GYM), (PLAIN, LIMITED), (CollectConfig(steps=3, anywhere=0.0), GYM)
    drives = [drive_episode(config, 0, world=world) for config, world in ways]
    assert [bool(each["ended"]) for each in drives] == [True, True, False]
    assert ["terminal" in each for each in drives] == [False, True, False]
    paths = [write(tmp_path, number, each) for number, each in enumerate(drives)]
    assert [bool(load_steps(path)["terminal"]) for path in paths] == [True, False, False]
    encoded = [encoded_drive(tmp_path, number, path) for number, path in enumerate(paths)]
    done = load_rollouts(encoded).done
    assert done.sum(dim=1).tolist() == [1, 0, 0]
    assert done[0, len(drives[0]["reward"]) - 1] == 1
    assert drives[0]["picture"].max(axis=(1, 2, 3)).min() > 0, "the black picture after a death"


def encoded_drive(folder, number, path, **more):
    """The encoded episode of a drive, with noise as its latents."""
    steps, target = load_steps(path), folder / "encoded" / f"{number:06d}.npz"
    target.parent.mkdir(exist_ok=True)
    noise = np.random.default_rng(number).standard_normal((len(steps["reward"]), 4)).astype(np.float32)
    named = dict.fromkeys(("mu", "logvar", "mirrored_mu", "mirrored_logvar"), noise)
    np.savez(target, **steps, **named, **load_arrays(path, "world"), **more)
    return target


def test_an_environment_is_closed_when_its_drive_fails(monkeypatch):
    def fail(_self, _action):
        raise RuntimeError("the game is gone")

    closed = []
    monkeypatch.setattr(Dodge, "step", fail)
    monkeypatch.setattr(Dodge, "close", lambda _self: closed.append(1))
    with pytest.raises(RuntimeError, match="the game is gone"):
        drive_episode(PLAIN, 0, world=TASK)
    assert closed == [1]


def test_a_mirrored_drive_has_its_worlds_mirrored_actions_and_no_action_is_widened(tmp_path):
    left = np.tile(np.array([0, 1, 0], np.float32), (12, 1))
    dodge = encoded_drive(tmp_path, 0, write_drive(tmp_path, 0, world=TASK, action=left))
    car = encoded_drive(tmp_path, 1, write_drive(tmp_path, 1, action=left - 0.5))
    batch = load_rollouts([dodge, car], np.array([True, True])).action
    assert batch[0, 0].tolist() == [0, 0, 1]
    assert batch[1, 0].tolist() == [0.5, 0.5, -0.5]
    narrow = encoded_drive(tmp_path, 2, write_drive(tmp_path, 2, actions=1))
    with pytest.raises(UsageError, match=r"3.*\(12, 1\)"):
        load_rollouts([narrow], np.array([True]))
    for paths in ([car, narrow], [narrow, car]):
        with pytest.raises(DatasetError, match=r"\(1,\).*\(3,\)"):
            load_rollouts(paths)
    with pytest.raises(DatasetError):
        pad([left, left[:, :1]])
    still = encoded_drive(tmp_path, 3, write_drive(tmp_path, 3, world=GYM._replace(options='{"skip": 2}')))
    load_rollouts([still])
    with pytest.raises(DatasetError, match=r"gym:.*{\"skip\": 2}"):
        load_rollouts([still], np.array([True]))


def test_two_worlds_never_mix(tmp_path):
    data, run = tmp_path / "data", tmp_path / "run"
    car = write_drive(data, 0)
    dodge, skipped = write_drive(run, 0, world=TASK), write_drive(run, 1, world=GYM)
    with pytest.raises(DatasetError, match=rf"000000\.npz.*car-racing.*{DODGE_TASK}"):
        list(collect(data, PLAIN, 1, world=TASK))
    for folder, drives in ((data, [dodge]), (tmp_path / "new", [dodge, skipped])):
        with pytest.raises(DatasetError, match="npz"):
            list(import_rollouts(folder, drives))
    with pytest.raises(DatasetError, match=rf"{DODGE_TASK}.*car-racing"):
        check_pictures([car, dodge], 64)
    store_preset(tmp_path / "begun", "pixels", 0, GYM)
    with pytest.raises(DatasetError, match=r"gym:.*Dodge-v0.*begun.*car-racing"):
        list(import_rollouts(tmp_path / "begun", [car]))
    assert list(import_rollouts(tmp_path / "new", [dodge])) == [12]
    assert world_of_folder(tmp_path / "new") == TASK


def test_a_data_set_keeps_the_world_that_it_was_begun_in(tmp_path):
    words = ("--data", tmp_path, "--episodes", 2, "--steps", 3)
    options = ("--observation", "render", "--size", 96, "--skip", 2)
    assert call(*words, "--task", "gym:CartPole-v1", *options) == 0
    stored = json.loads((tmp_path / "preset.json").read_text())
    assert stored.pop("options") == '{"observation": "render", "size": 96, "skip": 2}'
    assert stored == {"preset": "pixels", "seed": 0, "task": "gym:CartPole-v1"}
    assert call(*words, "--task", "gym:CartPole-v1", *options) == call(*words) == 0
    for path in existing_episodes(tmp_path):
        assert load_pictures(path).shape[1:] == (96, 96, 3)
        assert load_steps(path)["reward"].tolist() == [2, 2, 2][: len(load_steps(path)["reward"])]
    for other in (("--task", "car-racing"), ("--task", "gym:CartPole-v1"), ("--skip", 3)):
        with pytest.raises(UsageError, match="gym:CartPole-v1"):
            call(*words, *other)
    with pytest.raises(UsageError, match="--task"):
        call(*words, "--from-run", "night", "--task", "car-racing")


@pytest.mark.parametrize(
    ("task", "arguments", "error"),
    [
        (None, {"skip": 2}, "--skip"),
        (DODGE_TASK, {"size": 96, "crop": "0:9,0:9"}, "--size, --crop"),
        ("takecover", {"size": 96}, "size"),
        ("gym:CartPole-v1", {"crop": "half"}, None),
        ("ghost", {}, "ghost"),
    ],
)
def test_a_world_without_such_options_is_refused(tmp_path, task, arguments, error):
    with pytest.raises(UsageError, match=error):
        resolve_world(tmp_path, task, arguments)


def test_without_flags_a_new_data_set_is_of_the_first_world(tmp_path):
    assert resolve_world(tmp_path, None, {}) == world_of_folder(tmp_path) == OF_FIRST_WORLD
    assert resolve_world(tmp_path, "takecover", {"skip": 1}).options == '{"environment": {"tics": 1}}'
    assert find_own_world(tmp_path) is None


@pytest.mark.add_on
def test_a_preset_is_of_the_data_sets_world(tmp_path):
    store_preset(tmp_path, "pixels", 3, CART)
    assert (world_of_folder(tmp_path), load_preset(tmp_path)) == (CART, "pixels")
    assert resolve_preset(tmp_path, None) == resolve_preset(tmp_path, "pixels") == "pixels"
    with pytest.raises(UsageError, match=r"pixels.*--preset tiny"):
        resolve_preset(tmp_path, "tiny")
    new = tmp_path / "new"
    assert resolve_preset(new, None, TASK) == "pixels"
    assert resolve_preset(new, None, DataWorld("takecover")) == "takecover"
    for preset, world, own in (("tiny", TASK, "car-racing"), ("takecover", OF_FIRST_WORLD, "takecover")):
        with pytest.raises(UsageError, match=f"{preset}.*{own}.*{world}"):
            resolve_preset(new, preset, world)
    (tmp_path / "preset.json").write_text('{"preset": "pixels", "task": 5}')
    with pytest.raises(DatasetError, match=r"preset\.json"):
        world_of_folder(tmp_path)


@pytest.mark.parametrize("flags", [("--driver", "ghost"), ("--picture", "96"), ("--anywhere", "0.5")])
def test_a_refused_command_begins_no_data_set(tmp_path, flags):
    with pytest.raises(UsageError):
        call("--data", str(tmp_path), "--task", DODGE_TASK, *flags)
    assert not list(tmp_path.iterdir())


def test_a_controller_of_another_world_drives_for_no_data_set(tmp_path):
    pilot = Pilot(find_controller("tiny", tmp_path)[0], find_bundle("tiny"))
    with pytest.raises(ControllerError, match=rf"car-racing.*'box-64'.*{DODGE_TASK}"):
        list(collect(tmp_path, PLAIN, 1, (pilot,), TASK))


def test_a_runs_rollouts_say_the_world_of_its_world_model(tmp_path):
    facts = DodgeTask.world.facts(RewardFacts("survival"), EndRule())
    bundle = write_world_bundle(tmp_path / "dodge.zip", facts)
    scorer = Scorer(TaskSpec(DODGE_TASK, bundle.sha256, horizon=3, patience=0), bundle)
    _, rollout = scorer.collect(np.zeros(bundle.controller_shape.size, np.float32), seed=2**20)
    scorer.close()
    path = write(tmp_path, 0, rollout.arrays())
    assert world_of_episode(path) == DataWorld.of(bundle) == TASK
    assert load_pictures(path).shape == (3, *preprocessing_of_size(64, TASK).shape)
