"""The native picture is gymnasium's, to the bit. `dreamfleet lab bench env --exact` compares far more.
Tests car.py, environment.py, native_check.py, preprocessing.py, reference.py and worker/addons/bench/environment.py."""

import copy
from functools import cache

import gymnasium
import numpy as np
import psutil
import pytest
from gymnasium.error import InvalidAction
from gymnasium.utils.env_checker import check_env

import dreamfleet.worker.worlds.car_racing  # noqa: F401 - registers the environment
from dreamfleet import DreamfleetError, find_bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.addons.bench.environment import drive_lap, make_random_policy, random_discrete_action
from dreamfleet.worker.tasks.pictures import box_resize
from dreamfleet.worker.training.data.dataset import preprocessing_of_size
from dreamfleet.worker.worlds.car_racing import native_check
from dreamfleet.worker.worlds.car_racing.environment import (
    PICTURES,
    TEXTS,
    CarRacing,
    is_native_available,
    render_score,
    write_score,
)
from dreamfleet.worker.worlds.car_racing.native_check import (
    MANNERS,
    TRUTHS,
    compare,
    hash_drive,
    make_car_racing,
    make_unwrapped,
    native_is_exact,
    random_action,
)
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX, PREPROCESSINGS, RAW, WHOLE, find_preprocessing
from dreamfleet.worker.worlds.car_racing.reference import GymnasiumCarRacing
from dreamfleet.worker.worlds.car_racing.task import make_judging_environment

EXTREMES = [(9, 9, 9), (-9, -9, -9), (1e6, 1, 0), (-1, 1, 1), (0, 0, 0)]

needs_native = pytest.mark.skipif(not is_native_available(), reason="no native module was built")


@cache
def policy():
    return make_random_policy(find_bundle("tiny"))


@pytest.mark.slow
@needs_native
@pytest.mark.parametrize(
    ("steps", "actions", "settings"),
    [
        (160, random_action, {}),
        (160, lambda _step, seen, _random: policy().act(seen), {}),
        (260, lambda _step, _seen, _random: np.array([0.0, 1.0, 0.0], np.float32), {}),  # leaves the field
        (80, lambda step, _seen, _random: np.array(EXTREMES[step // 7 % 5], np.float32), {}),
        (100, random_action, {"domain_randomize": True}),
        (100, random_discrete_action, {"continuous": False}),
        (100, random_action, {"lap_complete_percent": 0.3}),
    ],
)
def test_driving_looks_the_same(steps, actions, settings):
    assert compare(6, steps, actions, **settings) is None


@needs_native
@pytest.mark.long
def test_a_completed_lap_looks_the_same_to_its_end():
    lap = drive_lap(3)
    assert compare(lap.seed, len(lap.actions) + 1, lambda step, _seen, _random: lap.actions[step]) is None


@needs_native
@pytest.mark.parametrize("width", [1, 2])
def test_wider_instructions_change_no_bit(width):
    from dreamfleet.worker.worlds.car_racing import _native

    if _native.widen(width) != width:
        _native.widen(2)
        pytest.skip("this processor has none")
    try:
        seen = []
        for each in (0, width):
            assert _native.widen(each) == each
            seen.append([drive_all([CarRacing(preprocessing=kind)], [11], 120)[0] for kind in ("raw-96", "box-64")])
    finally:
        _native.widen(2)
    assert all(map(np.array_equal, *seen))


@needs_native
def test_environments_that_take_turns_do_not_see_each_other():
    alone = [drive_all([CarRacing(preprocessing="box-64")], [seed], 30)[0] for seed in range(8)]
    together = drive_all([CarRacing(preprocessing="box-64") for _ in range(8)], range(8), 30)
    assert all(np.array_equal(one, other) for one, other in zip(alone, together, strict=True))


def drive_all(environments, seeds, steps):
    """The pictures of each environment, stepped in turn."""
    seen = [[environment.reset(seed=seed)[0]] for environment, seed in zip(environments, seeds, strict=True)]
    for step in range(steps):
        for index, (environment, seed) in enumerate(zip(environments, seeds, strict=True)):
            seen[index].append(environment.step(np.array([0.1 * seed, 0.5, 0], np.float32))[0])
            if step == 10:
                environment.t += 1.0
    return [np.stack(pictures) for pictures in seen]


@needs_native
def test_one_more_environment_adds_little_memory():
    def drawing():
        environment = CarRacing(preprocessing="box-64")
        drive_all([environment], [1], 20)
        return environment

    kept, process = [drawing() for _ in range(8)], psutil.Process()
    before = process.memory_info().rss
    kept.append(drawing())
    assert process.memory_info().rss - before < 6 * 2**20


@pytest.mark.slow
@needs_native
@pytest.mark.parametrize("name", PREPROCESSINGS)
def test_a_judging_environment_goes_on_while_pictures_are_equal(name):
    environment = CarRacing(preprocessing=name, checked=1)
    (seen,) = drive_all([environment], [3], 60)  # the score's text and the bars change too
    assert len(np.unique(seen, axis=0)) > 50


@needs_native
@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("_draw", lambda right, self, shape: right(self, shape) ^ (np.indices(shape).sum(axis=0) == 0)),
        ("step", lambda right, self, action: right(self, action * np.float32(0.5))),
    ],
)
def test_another_picture_or_reward_ends_an_evaluation(monkeypatch, name, wrong):
    environment = make_judging_environment(BOX)
    environment.reset(seed=1)
    inner = environment.unwrapped
    right = getattr(CarRacing, name)
    if name == "step":
        monkeypatch.setattr(inner.shadow, "step", lambda action: type(inner.shadow).step(inner.shadow, action / 2))
    else:
        monkeypatch.setattr(CarRacing, name, lambda self, given: wrong(right, self, given))
    with pytest.raises(DreamfleetError, match="PICTURES=gymnasium"):
        [environment.step(np.array([0, 1, 0], np.float32)) for _ in range(50)]


@pytest.mark.parametrize(("said", "by"), [("", "native"), ("gymnasium", "gymnasium")])
def test_a_user_may_let_gymnasium_draw(monkeypatch, said, by):
    monkeypatch.setenv(PICTURES, said)
    native_is_exact.cache_clear()
    try:
        assert make_car_racing().unwrapped.drawn_by == by if is_native_available() else "gymnasium"
    finally:
        native_is_exact.cache_clear()
    assert getattr(make_judging_environment(BOX, "rgb_array").unwrapped, "drawn_by", "-") == "-"


def test_where_it_was_not_built_gymnasium_drives_and_a_copy_is_made_as_its_original(monkeypatch):
    monkeypatch.setattr(native_check, "is_native_available", lambda: False)
    ours, small = make_unwrapped(checked=7), make_unwrapped(preprocessing="box-64")
    observation, small_one = ours.reset(seed=1)[0], small.reset(seed=1)[0]
    assert ours.drawn_by == "gymnasium"
    assert np.array_equal(BOX.picture(observation), small_one)
    copied = copy.deepcopy(GymnasiumCarRacing(preprocessing="box-64", domain_randomize=True))
    assert (copied.domain_randomize, copied.observation_space.shape) == (True, BOX.shape)


@needs_native
def test_a_copy_of_the_native_one_is_made_as_its_original():
    copied = copy.deepcopy(CarRacing(preprocessing="box-64", checked=7, domain_randomize=True))
    assert (copied._checked, copied.domain_randomize, copied.observation_space.shape) == (7, True, BOX.shape)


@needs_native
@pytest.mark.parametrize("manner", MANNERS)
def test_the_hashes_of_drives_are_gymnasiums(manner):
    truths = TRUTHS[manner].split()
    assert [hash_drive(CarRacing, manner, seed) for seed in range(len(truths))] == truths
    assert [hash_drive(GymnasiumCarRacing, manner, seed) for seed in (0, 1)] == truths[:2]


@pytest.mark.parametrize("action", [np.array([np.nan, 0, 0]), np.array([0, np.inf, 0]), np.zeros(2), np.zeros((1, 3))])
def test_an_action_that_is_none_is_refused_and_the_environment_goes_on(action):
    for environment in (CarRacing(), GymnasiumCarRacing()):
        environment.reset(seed=1)
        with pytest.raises(InvalidAction):
            environment.step(action)
        environment.step(np.zeros(3, np.float32))


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_finds_it_a_well_made_environment():
    environment = gymnasium.make("dreamfleet/CarRacing-v3", render_mode="rgb_array")
    assert environment.spec.max_episode_steps == 1000
    check_env(environment.unwrapped, skip_render_check=False)
    environment.reset(seed=1)
    assert environment.render().shape == (400, 600, 3)


def test_the_kept_texts_are_pygames_and_another_one_is_written():
    for text in (*TEXTS[::50], TEXTS[-1], "-000", "-4567"):
        assert np.array_equal(render_score(text), write_score(text)), text


@pytest.mark.parametrize("seed", range(5))
def test_the_picture_is_the_exact_integer_box_filter_and_the_raw_one_is_whole(seed):
    observation = np.random.default_rng(seed).integers(0, 256, (96, 96, 3), dtype=np.uint8)
    assert np.array_equal(BOX.picture(observation), box_resize(observation[:84], 64))
    assert np.array_equal(RAW.picture(observation), observation)


def test_a_preprocessing_is_found_by_name_and_by_size():
    for each in (BOX, RAW):
        assert find_preprocessing(each.name) is preprocessing_of_size(each.size) is each
        assert each.picture(np.zeros((96, 96, 3), np.uint8)).shape == each.shape
    with pytest.raises(UsageError, match=r"'bilinear-64'.*box-64, raw-96"):
        find_preprocessing("bilinear-64")
    with pytest.raises(UsageError, match="32"):
        preprocessing_of_size(32)


@pytest.mark.parametrize("levels", [256, 2])
def test_the_whole_picture_is_pillows_to_the_bit(levels):
    image = pytest.importorskip("PIL.Image")
    random = np.random.default_rng(levels)
    for _ in range(20):
        observation = (random.integers(0, levels, (96, 96, 3)) * (255 // (levels - 1))).astype(np.uint8)
        wanted = image.fromarray(observation).resize((64, 64), image.Resampling.BILINEAR)
        assert np.array_equal(WHOLE.picture(observation), np.asarray(wanted))


def test_the_environment_draws_the_whole_picture():
    raw, whole = (CarRacing(preprocessing=each.name).reset(seed=3)[0] for each in (RAW, WHOLE))
    assert np.array_equal(WHOLE.picture(raw), whole)
