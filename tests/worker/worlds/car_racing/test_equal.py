"""The native picture is gymnasium's, to the bit. `dreamfleet lab bench env --exact` compares far more.
Tests environment.py, native_check.py and worker/addons/bench/environment.py."""

import copy
import os
from pathlib import Path

import gymnasium
import numpy as np
import pygame
import pytest
from gymnasium.error import InvalidAction

import dreamfleet.worker.worlds.car_racing  # noqa: F401 - registers the environment
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.errors import DreamfleetError
from dreamfleet.worker.addons.bench.environment import drive_lap, make_random_policy, random_discrete_action
from dreamfleet.worker.worlds.car_racing.environment import (
    GRASS,
    PICTURES,
    WHEEL,
    CarRacing,
    _native,
    is_native_available,
    render_score,
)  # fmt: skip
from dreamfleet.worker.worlds.car_racing.native_check import compare, make_car_racing, native_is_exact, random_action
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX, PREPROCESSINGS
from dreamfleet.worker.worlds.car_racing.task import make_judging_environment

needs_native = pytest.mark.skipif(not is_native_available(), reason="no native module was built")


@needs_native
def test_the_quick_look_at_a_workers_start_finds_it_exact():
    assert native_is_exact()


@pytest.mark.slow
@needs_native
@pytest.mark.parametrize("seed", [3, 4])
def test_random_driving_looks_the_same(seed):
    assert compare(seed, 160, random_action) is None


@pytest.mark.slow
@needs_native
def test_evolved_driving_looks_the_same():
    act = make_random_policy(find_bundle("tiny")).act
    assert compare(5, 160, lambda _step, seen, _random: act(seen)) is None


@needs_native
@pytest.mark.long
def test_a_completed_lap_looks_the_same_to_its_end():
    lap = drive_lap(3)
    assert compare(lap.seed, len(lap.actions) + 1, lambda step, _seen, _random: lap.actions[step]) is None


@needs_native
@pytest.mark.parametrize("width", [1, 2])
def test_wider_instructions_change_no_bit(width):
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


@pytest.mark.slow
@needs_native
def test_leaving_the_field_looks_the_same():
    def straight_out(_step, _picture, _random):
        return np.array([0.0, 1.0, 0.0], np.float32)

    assert compare(6, 260, straight_out) is None


@pytest.mark.slow
@needs_native
@pytest.mark.parametrize(
    ("settings", "actions"),
    [
        ({"domain_randomize": True}, random_action),
        ({"continuous": False}, random_discrete_action),
        ({"lap_complete_percent": 0.3}, random_action),
    ],
)
def test_every_option_looks_the_same(settings, actions):
    assert compare(7, 100, actions, **settings) is None


@needs_native
def test_extreme_actions_behave_as_gymnasiums():
    extremes = [(9, 9, 9), (-9, -9, -9), (1e6, 1, 0), (-1, 1, 1), (0, 0, 0)]
    assert compare(8, 80, lambda step, _seen, _random: np.array(extremes[step // 7 % 5], np.float32)) is None


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

    kept = [drawing() for _ in range(8)]
    before = memory()
    kept.append(drawing())
    assert memory() - before < 6 * 2**20


def memory():
    """The resident memory of this process, in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@needs_native
@pytest.mark.parametrize("x", [np.nan, np.inf, 1e30])
def test_a_car_that_cannot_be_drawn_is_a_clear_error(x):
    environment = CarRacing(preprocessing="box-64")
    environment.reset(seed=1)
    with pytest.raises(ValueError, match="too far away"):
        _native.scene(
            np.empty((96, 96, 3), np.uint8), environment._road, environment._road_colours, GRASS, environment._palette,
            np.array([16.2, 0, x, 0, 333]), np.zeros((5, 4)), environment._fixtures, WHEEL,
        )  # fmt: skip


@pytest.mark.slow
@needs_native
@pytest.mark.parametrize("name", PREPROCESSINGS)
def test_a_judging_environment_goes_on_while_pictures_are_equal(name):
    environment = CarRacing(preprocessing=name, checked=1)
    (seen,) = drive_all([environment], [3], 60)  # the score's text and the bars change too
    assert len(np.unique(seen, axis=0)) > 50


@needs_native
def test_a_wrong_picture_ends_an_evaluation(monkeypatch):
    environment = make_judging_environment(BOX)
    environment.reset(seed=1)
    right = CarRacing._draw
    monkeypatch.setattr(CarRacing, "_draw", lambda self: right(self) ^ (np.indices(BOX.shape).sum(axis=0) == 0))
    still = np.zeros(3, np.float32)
    with pytest.raises(DreamfleetError, match="PICTURES=gymnasium"):
        [environment.step(still) for _ in range(50)]


@pytest.mark.parametrize(("said", "by"), [("", "native"), ("gymnasium", "gymnasium")])
def test_a_user_may_let_gymnasium_draw(monkeypatch, said, by):
    monkeypatch.setenv(PICTURES, said)
    native_is_exact.cache_clear()
    try:
        assert make_car_racing().unwrapped.drawn_by == by if is_native_available() else "gymnasium"
    finally:
        native_is_exact.cache_clear()
    assert getattr(make_judging_environment(BOX, "rgb_array").unwrapped, "drawn_by", "-") == "-"


def test_a_copy_draws_as_its_original():
    copied = copy.deepcopy(CarRacing(preprocessing="box-64", native=False, checked=7, domain_randomize=True))
    assert (copied._checked, copied.drawn_by, copied.domain_randomize) == (7, "gymnasium", True)
    assert copied.observation_space.shape == BOX.shape


@needs_native
def test_where_gymnasium_draws_it_drives_too(monkeypatch):
    monkeypatch.setattr("dreamfleet.worker.worlds.car_racing.car.STIFFNESS", 100_000)  # as if we computed otherwise
    action, positions = np.array([0.3, 0.8, 0], np.float32), []
    for environment in (gymnasium.make("CarRacing-v3").unwrapped, CarRacing(native=False), CarRacing()):
        environment.reset(seed=3)
        for _ in range(40):
            environment.step(action)
        positions.append(tuple(environment.car.hull.position))
    assert positions[0] == positions[1] != positions[2]


def test_where_it_was_not_built_gymnasium_draws():
    ours, small = CarRacing(native=False), CarRacing(native=False, preprocessing="box-64")
    observation, small_one = ours.reset(seed=1)[0], small.reset(seed=1)[0]
    assert ours.drawn_by == "gymnasium"
    assert np.array_equal(BOX.picture(observation), small_one)


@pytest.mark.parametrize("action", [np.array([np.nan, 0, 0]), np.array([0, np.inf, 0]), np.zeros(2), np.zeros((1, 3))])
def test_an_action_that_is_none_is_refused_and_the_environment_goes_on(action):
    environment = CarRacing()
    environment.reset(seed=1)
    with pytest.raises(InvalidAction):
        environment.step(action)
    environment.step(np.zeros(3, np.float32))


@pytest.mark.filterwarnings("ignore")
def test_gymnasium_finds_it_a_well_made_environment():
    from gymnasium.utils.env_checker import check_env

    environment = gymnasium.make("dreamfleet/CarRacing-v3", render_mode="rgb_array")
    check_env(environment.unwrapped, skip_render_check=False)
    environment.reset(seed=1)
    assert environment.render().shape == (400, 600, 3)


def test_an_episode_ends_after_a_thousand_steps():
    assert make_car_racing(preprocessing="box-64").spec.max_episode_steps == 1000


def test_a_score_is_written_after_somebody_closed_pygame():
    before = render_score("0012").copy()
    pygame.quit()
    render_score.cache_clear()
    assert np.array_equal(render_score("0012"), before)


def test_score_texts_are_kept():
    assert render_score("0123") is render_score("0123")
