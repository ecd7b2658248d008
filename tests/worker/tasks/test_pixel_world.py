"""Pictures, actions and drivers of any world, and what holds of every recordable task.
Tests drivers.py and pictures.py."""

from fractions import Fraction
from functools import cache
from itertools import pairwise

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from dreamfleet.common.artifacts.actions import Continuous
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.tasks.drivers import HeldActions, UniformActions
from dreamfleet.worker.tasks.pictures import (
    CropAndResize,
    FrameDifference,
    SkipFrames,
    VectorActions,
    box_resize,
    drawn_pixels,
    is_picture,
    to_pixels,
)
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worlds.car_racing.preprocessing import BOX
from tests.support.pixel_world import ACTIONS, DODGE, DODGE_TASK
from tests.support.world_contract import check_world

THIRDS = Continuous.between([-1], [1])


def random_picture(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def mean_of_area(picture, size, i, j, channel):
    """The mean of a new pixel's area by fractions; halves are rounded up."""
    rows, columns = share(picture.shape[0], size, i), share(picture.shape[1], size, j)
    mean = sum(row * column * int(picture[r, c, channel]) for r, row in rows.items() for c, column in columns.items())
    return int(mean + Fraction(1, 2))


@cache
def share(length, size, i):
    """The share of new pixel `i` that each old one covers."""
    start, end = Fraction(i * length, size), Fraction((i + 1) * length, size)
    cover = {r: min(end, Fraction(r + 1)) - max(start, Fraction(r)) for r in range(length)}
    return {r: part * size / length for r, part in cover.items() if part > 0}


@pytest.mark.parametrize(("height", "width"), [(48, 40), (9, 7), (16, 16), (1, 3), (17, 33)])
def test_a_resized_pixel_is_the_rounded_mean_of_its_area(height, width):
    picture = random_picture(height, width, 3)
    for size in (16, 5):
        slow = [mean_of_area(picture, size, *index) for index in np.ndindex(size, size, 3)]
        assert box_resize(picture, size).ravel().tolist() == slow


@pytest.mark.parametrize("seed", range(5))
def test_the_resize_is_car_racings_where_both_apply(seed):
    observation = random_picture(96, 96, 3, seed=seed)
    assert np.array_equal(box_resize(observation[:84], 64), BOX.picture(observation))


@pytest.mark.parametrize(("height", "width"), [(240, 320), (480, 640), (1080, 1920)])
def test_large_pictures_are_exact_too(height, width):
    picture = random_picture(height, width, 1)
    small = box_resize(picture, 64)
    for i, j in ((0, 0), (17, 40), (63, 63)):
        assert small[i, j, 0] == mean_of_area(picture, 64, i, j, 0)
    assert (box_resize(np.full((height, width, 3), 255, np.uint8), 64) == 255).all()


def test_grey_and_float_pictures_become_pixels():
    grey = random_picture(4, 5)
    assert np.array_equal(to_pixels(grey), np.stack([grey] * 3, axis=-1))
    assert np.array_equal(to_pixels(grey[..., None]), to_pixels(grey))
    assert np.array_equal(to_pixels(grey.astype(np.float32) / np.float32(255)), to_pixels(grey))


@pytest.mark.parametrize(
    ("space", "is_one"),
    [
        (spaces.Box(0, 255, (8, 9, 3), np.uint8), True),
        (spaces.Box(0, 255, (8, 9, 1), np.uint8), True),
        (spaces.Box(0, 1, (8, 9), np.float32), True),
        (spaces.Box(0, 255, (7, 7, 3), np.uint8), False),
        (spaces.Box(0, 255, (8, 9, 4), np.uint8), True),
        (spaces.Box(0, 255, (3, 8, 9), np.uint8), True),
        (spaces.Box(0, 1, (4, 8, 9), np.float32), True),
        (spaces.Box(0, 255, (2, 8, 9, 3), np.uint8), True),
        (spaces.Box(0, 255, (2, 3, 8, 9), np.uint8), True),
        (spaces.Box(0, 255, (2, 2, 8, 9), np.uint8), False),
        (spaces.Box(0, 255, (17, 18, 19), np.uint8), False),
        (spaces.Box(0, 9, (24, 18), np.uint8), False),
        (spaces.Box(-np.inf, np.inf, (5, 5), np.float32), False),
        (spaces.Box(0, 1, (16, 2), np.float32), False),
        (spaces.Box(0, 255, (8, 9, 3), np.float32), False),
        (spaces.Box(-1, 1, (8, 9, 3), np.float32), False),
        (spaces.Box(0, 255, (8, 9, 3), np.int64), False),
        (spaces.Box(0, 255, (8,), np.uint8), False),
        (spaces.Discrete(3), False),
    ],
)
def test_a_picture_is_known_by_its_space(space, is_one):
    assert is_picture(space) == is_one


@pytest.mark.parametrize(
    "drawn",
    [
        np.full((4, 6, 3), 51, np.uint8),
        np.full((4, 6, 4), 51, np.uint8),
        np.full((4, 6, 3), 0.2, np.float32),
        np.full((4, 6), 0.2),
        np.full((4, 6, 3), 51.0),
        np.full((4, 6, 1), 51, np.int64),
        [np.zeros((4, 6, 3), np.uint8), np.full((4, 6, 3), 51, np.uint8)],
    ],
    ids=["plain", "opacity", "floats", "grey floats", "floats up to 255", "whole numbers", "several"],
)
def test_what_an_environment_draws_is_taken_in_any_kind_of_number(drawn):
    found = drawn_pixels(drawn)
    assert (found.dtype, found.shape, np.unique(found).tolist()) == (np.uint8, (4, 6, 3), [51])


@pytest.mark.parametrize(
    "drawn", [None, "map", [], np.zeros(3), np.zeros((4, 6, 2)), np.zeros((0, 6, 3)), np.array(["a"])]
)
def test_what_is_no_picture_is_none(drawn):
    assert drawn_pixels(drawn) is None


class Scripted(gymnasium.Env):
    """Observes a plain picture of the step's number times ten; ends after five steps."""

    observation_space, action_space = spaces.Box(0, 255, (8, 12, 3), np.uint8), spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.picture(), {}

    def step(self, action):
        self.taken, self.steps = action, self.steps + 1
        return self.picture(), float(self.steps), self.steps == 5, False, {"step": self.steps}

    def picture(self):
        return np.full((8, 12, 3), 10 * self.steps, np.uint8)


@pytest.mark.parametrize(
    "later",
    [np.zeros((4, 12, 3), np.uint8), np.zeros((8, 12, 3), np.int64), np.zeros((8, 12, 3), np.float32), None],
)
def test_a_picture_of_another_kind_than_declared_is_refused(later):
    class Changing(Scripted):
        def picture(self):
            return later if self.steps else super().picture()

    environment = CropAndResize(Changing(), 64)
    environment.reset()
    with pytest.raises(ValueError, match=r"Box\(0, 255, \(8, 12, 3\), uint8\)"):
        environment.step(0)


@pytest.mark.parametrize(("value", "found"), [(-0.1, "-0.1"), (1.1, "1.1"), (255, "255"), (np.nan, "NaN")])
def test_a_picture_of_floats_beyond_0_to_1_is_refused(value, found):
    with pytest.raises(ValueError, match=found):
        to_pixels(np.full((8, 12, 3), value, np.float32))


def test_a_held_action_adds_rewards_and_stops_at_an_end():
    environment = SkipFrames(Scripted(), 3)
    environment.reset()
    assert environment.step(0)[1:] == (1 + 2 + 3, False, False, {"step": 3})
    assert environment.step(0)[1:] == (4 + 5, True, False, {"step": 5})
    with pytest.raises(UsageError):
        SkipFrames(Scripted(), 0)


def test_a_part_of_the_picture_is_resized():
    class Halves(Scripted):
        observation_space = spaces.Box(0, 255, (8, 16, 3), np.uint8)

        def picture(self):
            picture = np.zeros((8, 16, 3), np.uint8)
            picture[:, 8:] = 200
            return picture

    environment = CropAndResize(Halves(), 64, crop=(0, 8, 8, 16))
    assert environment.observation_space == spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert (environment.reset()[0] == 200).all()
    assert (CropAndResize(Halves(), 96).reset()[0][:, :48] == 0).all()
    for crop in ((0, 9, 0, 16), (0, 8, 9, 16), (0, 1, 0, 1)):
        with pytest.raises(UsageError):
            CropAndResize(Halves(), 64, crop=crop)
    with pytest.raises(UsageError):
        CropAndResize(gymnasium.make("CartPole-v1"), 64)


def test_the_difference_is_of_whole_numbers_and_begins_anew_at_a_reset():
    environment = FrameDifference(Scripted())
    assert environment.reset()[0][0, 0].tolist() == [0, 0, 128]
    assert environment.step(0)[0][0, 0].tolist() == [10, 0, 133]
    assert environment.step(0)[0][0, 0].tolist() == [20, 10, 133]
    assert environment.reset()[0][0, 0].tolist() == [0, 0, 128]


@pytest.mark.parametrize(("before", "now", "expected"), [(0, 255, 255), (255, 0, 0), (1, 0, 127), (0, 1, 128)])
def test_every_difference_fits_into_a_byte(before, now, expected):
    class Two(Scripted):
        def picture(self):
            return np.full((8, 12, 3), now if self.steps else before, np.uint8)

    environment = FrameDifference(Two())
    environment.reset()
    assert environment.step(0)[0][0, 0].tolist() == [now, before, expected]


def test_grey_weighs_the_colours():
    class Colours(Scripted):
        def picture(self):
            picture = np.zeros((8, 12, 3), np.uint8)
            picture[0, 0], picture[0, 1], picture[0, 2] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
            return picture

    assert FrameDifference(Colours()).reset()[0][0, :4, 0].tolist() == [76, 149, 28, 0]


@pytest.mark.parametrize(("value", "taken"), [(-1.0, 0), (-0.3, 1), (0.3, 1), (0.5, 2)])
def test_a_simulator_gets_its_own_actions(value, taken):
    environment = VectorActions(Scripted(), THIRDS, lambda action: int(np.digitize(action[0], (-1 / 3, 1 / 3))))
    environment.reset()
    environment.step(np.float32([value]))
    assert environment.unwrapped.taken == taken
    assert environment.action_space == spaces.Box(-1, 1, (1,), np.float32)


@pytest.mark.parametrize("action", [np.zeros(2, np.float32), np.float32(0), np.float32([np.nan])])
def test_another_action_is_refused_before_anything_moves(action):
    environment = VectorActions(Scripted(), THIRDS, int)
    environment.reset()
    with pytest.raises(gymnasium.error.InvalidAction):
        environment.step(action)
    assert environment.unwrapped.steps == 0


def test_drivers_draw_every_choice_and_the_whole_range():
    chosen = np.stack([UniformActions(np.random.default_rng(seed), ACTIONS).act() for seed in range(60)])
    assert (chosen.sum(axis=0) > 8).all()
    bounds = Continuous.between([-2, 0], [2, 1])
    driver = UniformActions(np.random.default_rng(1), bounds)
    drawn = np.stack([driver.act() for _ in range(400)])
    assert (drawn.min(axis=0) < [-1.9, 0.05]).all()
    assert (drawn.max(axis=0) > [1.9, 0.95]).all()


def test_a_held_action_lasts_for_a_drawn_number_of_steps():
    driver = HeldActions(np.random.default_rng(1), THIRDS, shortest=2, longest=4)
    actions = [float(driver.act()[0]) for _ in range(600)]
    lengths = [1]
    for before, now in pairwise(actions):
        if now == before:
            lengths[-1] += 1
        else:
            lengths.append(1)
    assert set(lengths[:-1]) == {2, 3, 4}


def test_the_pixel_world_is_gymnasiums_and_punishes_standing_still():
    environment = gymnasium.make(DODGE.removeprefix("gym:"), render_mode="rgb_array")
    assert environment.unwrapped.metadata["render_fps"] == 10
    lives = []
    for seed in range(20):
        environment.reset(seed=seed)
        ended, steps = False, 0
        while not ended:
            picture, _, *ends, _ = environment.step(0)
            ended, steps = any(ends), steps + 1
        lives.append(steps)
        assert not picture.any()
    assert np.array_equal(environment.render(), picture)
    assert 10 <= np.mean(lives) < 40


@pytest.mark.parametrize("name", [pytest.param("car-racing", marks=pytest.mark.slow), DODGE_TASK])
def test_a_recordable_task_keeps_the_contract(name):
    check_world(find_task(name))
