"""Pictures, actions and drivers of any world, and what holds of every recordable task.
Tests closing.py, drivers.py, pictures.py and reset.py."""

import signal
from contextlib import suppress
from fractions import Fraction
from functools import cache
from itertools import groupby
from time import monotonic

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from dreamfleet import Continuous, UsageError
from dreamfleet.common.runs.seeds import fold_seed, training_seed
from dreamfleet.worker.tasks import closing
from dreamfleet.worker.tasks.closing import close_environment
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
from dreamfleet.worker.tasks.reset import reset_folded
from tests.support.pixel_world import ACTIONS, DODGE_TASK
from tests.support.stuck_environments import StuckClose
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


@pytest.mark.parametrize(("height", "width"), [(480, 640), (1080, 1920)])
def test_large_pictures_are_exact_too(height, width):
    picture = random_picture(height, width, 1)
    small = box_resize(picture, 64)
    for i, j in ((0, 0), (17, 40), (63, 63)):
        assert small[i, j, 0] == mean_of_area(picture, 64, i, j, 0)
    assert (box_resize(np.full((height, width, 3), 255, np.uint8), 64) == 255).all()


def test_grey_and_float_pictures_become_pixels_and_floats_beyond_0_to_1_are_refused():
    grey = random_picture(4, 5)
    assert np.array_equal(to_pixels(grey), np.stack([grey] * 3, axis=-1))
    assert np.array_equal(to_pixels(grey[..., None]), to_pixels(grey))
    assert np.array_equal(to_pixels(grey.astype(np.float32) / np.float32(255)), to_pixels(grey))
    for value, found in ((-0.1, "-0.1"), (1.1, "1.1"), (255, "255"), (np.nan, "NaN")):
        with pytest.raises(ValueError, match=found):
            to_pixels(np.full((8, 12, 3), value, np.float32))


def boxes(high, dtype, *shapes, low=0):
    return [spaces.Box(low, high, shape, dtype) for shape in shapes]


PICTURES = [
    *boxes(255, np.uint8, (8, 9, 3), (8, 9, 1), (8, 9, 4), (3, 8, 9), (2, 8, 9, 3), (2, 3, 8, 9)),
    *boxes(1, np.float32, (8, 9), (4, 8, 9)),
]
OTHERS = [
    *boxes(255, np.uint8, (7, 7, 3), (2, 2, 8, 9), (17, 18, 19), (8,)),
    *boxes(9, np.uint8, (24, 18)),
    *boxes(np.inf, np.float32, (5, 5), low=-np.inf),
    *boxes(1, np.float32, (16, 2)),
    *boxes(1, np.float32, (8, 9, 3), low=-1),
    *boxes(255, np.float32, (8, 9, 3)),
    *boxes(255, np.int64, (8, 9, 3)),
    spaces.Discrete(3),
]


@pytest.mark.parametrize("space", [*PICTURES, *OTHERS], ids=str)
def test_a_picture_is_known_by_its_space(space):
    assert is_picture(space) == (space in PICTURES)


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


def plain(value):
    return np.full((8, 12, 3), value, np.uint8)


class Scripted(gymnasium.Env):
    """Observes `picture(steps)`; ends after five steps."""

    observation_space, action_space = spaces.Box(0, 255, (8, 12, 3), np.uint8), spaces.Discrete(2)

    def __init__(self, picture=lambda steps: plain(10 * steps)):
        self.picture = picture

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.picture(0), {}

    def step(self, action):
        self.taken, self.steps = action, self.steps + 1
        return self.picture(self.steps), float(self.steps), self.steps == 5, False, {"step": self.steps}


@pytest.mark.parametrize("later", [plain(0)[:4], plain(0).astype(np.int64), plain(0).astype(np.float32), None])
def test_a_picture_of_another_kind_than_declared_is_refused(later):
    environment = CropAndResize(Scripted(lambda steps: later if steps else plain(0)), 64)
    environment.reset()
    with pytest.raises(ValueError, match=r"Box\(0, 255, \(8, 12, 3\), uint8\)"):
        environment.step(0)


def test_a_held_action_adds_rewards_and_stops_at_an_end():
    environment = SkipFrames(Scripted(), 3)
    environment.reset()
    assert environment.step(0)[1:] == (1 + 2 + 3, False, False, {"step": 3})
    assert environment.step(0)[1:] == (4 + 5, True, False, {"step": 5})
    with pytest.raises(UsageError):
        SkipFrames(Scripted(), 0)


def test_a_part_of_the_picture_is_resized():
    halves = Scripted(lambda _steps: np.hstack([plain(0)[:, :4], plain(200)[:, 4:]]))
    environment = CropAndResize(halves, 64, crop=(0, 8, 4, 12))
    assert environment.observation_space == spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert (environment.reset()[0] == 200).all()
    assert (CropAndResize(halves, 96).reset()[0][:, :32] == 0).all()
    for crop in ((0, 9, 0, 12), (0, 8, 9, 12), (0, 1, 0, 1)):
        with pytest.raises(UsageError):
            CropAndResize(halves, 64, crop=crop)
    with pytest.raises(UsageError):
        CropAndResize(gymnasium.make("CartPole-v1"), 64)


def test_the_difference_begins_anew_at_a_reset():
    environment = FrameDifference(Scripted())
    seen = [environment.reset()[0], environment.step(0)[0], environment.step(0)[0], environment.reset()[0]]
    assert [each[0, 0].tolist() for each in seen] == [[0, 0, 128], [10, 0, 133], [20, 10, 133], [0, 0, 128]]


@pytest.mark.parametrize(("before", "now", "expected"), [(0, 255, 255), (255, 0, 0), (1, 0, 127), (0, 1, 128)])
def test_every_difference_fits_into_a_byte(before, now, expected):
    environment = FrameDifference(Scripted(lambda steps: plain(now if steps else before)))
    environment.reset()
    assert environment.step(0)[0][0, 0].tolist() == [now, before, expected]


def test_grey_weighs_the_colours():
    colours = plain(0)
    colours[0, [0, 1, 2], [0, 1, 2]] = 255  # red, green, blue
    assert FrameDifference(Scripted(lambda _steps: colours)).reset()[0][0, :4, 0].tolist() == [76, 149, 28, 0]


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
    driver = UniformActions(np.random.default_rng(1), Continuous.between([-2, 0], [2, 1]))
    drawn = np.stack([driver.act() for _ in range(400)])
    assert (drawn.min(axis=0) < [-1.9, 0.05]).all()
    assert (drawn.max(axis=0) > [1.9, 0.95]).all()


def test_a_held_action_lasts_for_a_drawn_number_of_steps():
    driver = HeldActions(np.random.default_rng(1), THIRDS, shortest=2, longest=4)
    lengths = [len(list(same)) for _, same in groupby(float(driver.act()[0]) for _ in range(600))]
    assert set(lengths[:-1]) == {2, 3, 4}


@pytest.mark.parametrize("name", [pytest.param("car-racing", marks=pytest.mark.slow), DODGE_TASK])
def test_a_recordable_task_keeps_the_contract(name):
    check_world(find_task(name))


LONG, LONGEST = training_seed(7, 0, 0), 2**53 - 1


class Environment(gymnasium.Env):
    """Its observation is the seed; `fails(seed, number)` raises for the reset of that number."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Discrete(2)

    def __init__(self, fails):
        self.seeds, self._fails = [], fails

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        if (error := self._fails(seed, len(self.seeds))) is not None:
            raise error
        return np.array([seed], np.float64), {}


@pytest.mark.parametrize("error", [ValueError("too long"), OverflowError("int too big"), TypeError("32 bits")])
@pytest.mark.parametrize("limit", [2**31, 2**32])
def test_an_environment_that_refuses_long_seeds_gets_them_folded(error, limit):
    environment = Environment(lambda seed, _: error if seed >= limit else None)
    assert reset_folded(environment, LONG)[0] == fold_seed(LONG)
    assert reset_folded(environment, LONG + 1)[0] == fold_seed(LONG + 1)
    assert reset_folded(environment, 5)[0] == 5


@pytest.mark.parametrize(
    "refuses", [lambda seed: seed >= 2**52, lambda seed: seed % 9 == LONGEST % 9, lambda seed: seed == LONGEST]
)
def test_what_a_seed_means_does_not_depend_on_the_seeds_before(refuses):
    environment = Environment(lambda seed, _: ValueError("no such level") if refuses(seed) else None)
    legal = next(seed for seed in range(LONG % 2**51, 2**52) if not refuses(seed))
    assert reset_folded(environment, legal)[0] == legal
    with pytest.raises(ValueError, match="no such level"):
        reset_folded(environment, LONGEST)
    assert reset_folded(environment, legal)[0] == legal


@pytest.mark.parametrize("error", [RuntimeError("no answer"), ValueError("no answer"), MemoryError(), OSError(24, "x")])
def test_a_reset_that_fails_by_chance_is_an_error_and_no_other_seed(error):
    for period in (3, 4, 5):
        environment = Environment(lambda _, number, period=period: error if number % period == 0 else None)
        found = []
        for each in range(12):
            with suppress(type(error)):
                assert reset_folded(environment, LONG + each)[0] == LONG + each
                found.append(each)
        assert 2 <= len(found) <= 10


def test_a_close_that_hangs_is_interrupted_and_not_called_again_and_another_is_whose_interrupt_passes(
    monkeypatch, caplog
):
    class Interrupted(StuckClose):
        def close(self):
            raise KeyboardInterrupt

    monkeypatch.setattr(closing, "CLOSE_LIMIT", 0.2)
    monkeypatch.setattr(closing, "_hung", {})
    StuckClose.calls.clear()
    before, began = signal.getsignal(signal.SIGALRM), monotonic()
    fault = close_environment(StuckClose())
    assert StuckClose.__name__ in fault
    assert caplog.messages == [fault]
    assert close_environment(StuckClose()) == fault
    assert monotonic() - began < 60
    assert len(StuckClose.calls) == 1
    assert signal.getsignal(signal.SIGALRM) == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0, 0)
    with pytest.raises(KeyboardInterrupt):
        close_environment(Interrupted())
