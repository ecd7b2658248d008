"""The native race is gymnasium's and Box2D's, to the bit: each body, each wheel, tiles, reward and end.
Tests native/*.c but for the picture. `python -m tests.worker.worlds.car_racing.truth` compares far more."""

from collections import Counter

import numpy as np
import pytest

from dreamfleet.worker.worlds.car_racing.environment import is_native_available

if not is_native_available():
    pytest.skip("no native module was built", allow_module_level=True)

from dreamfleet.worker.worlds.car_racing import _native
from tests.worker.worlds.car_racing.truth import MANNERS, Blind, compare, race_against

TILE = np.array([[0, 0], [0, 4], [9, 4], [9, 0]], np.float64)


def drive(environment, race, manner, seed, steps, **how):
    """Drive one episode in both; what happened."""
    counts = Counter()
    driver = MANNERS[manner](environment, np.random.default_rng(seed))
    assert race_against(environment, race, seed, driver, steps, counts, **how) is None
    return counts


@pytest.mark.parametrize("manner", MANNERS)
def test_every_manner_of_driving_gives_the_same_bits(manner):
    drive(Blind(), _native.Race(), manner, 3, 200)


def test_a_car_at_rest_falls_asleep_and_wakes_as_box2d_lets_it():
    assert drive(Blind(), _native.Race(), "still", 4, 300)["steps asleep"]


def test_a_lap_ends_the_same():
    assert drive(Blind(lap_complete_percent=0.1), _native.Race(), "follow", 5, 1500)["laps"]


def test_the_field_ends_the_same_and_is_left_the_same():
    assert drive(Blind(), _native.Race(), "away", 6, 700, beyond=True)["fields left"]


def test_a_world_that_is_used_again_keeps_the_same_traces():
    environment, race = Blind(), _native.Race()
    for seed in range(20, 25):
        drive(environment, race, "held", seed, 60)


@pytest.mark.long
def test_200_000_steps_give_the_same_bits():
    counts, difference = compare(200_000, seed=77)
    assert difference is None
    assert min(counts[what] for what in ("laps", "fields left", "steps asleep")) > 0


@pytest.mark.parametrize("action", [(np.nan, 0, 0), (0, np.inf, 0)])
def test_a_step_takes_three_finite_numbers_after_a_reset(action):
    race = _native.Race()
    with pytest.raises(ValueError):
        race.step(0, 0, 0)
    race.reset(TILE, (0.0, 0.0, 0.0), 0.95)
    with pytest.raises(ValueError):
        race.step(*action)
    assert race.step(0, 1, 0)[0] == pytest.approx(999.9)


@pytest.mark.parametrize("tiles", [b"", TILE[:3], TILE * np.nan])
def test_a_damaged_track_is_refused_and_the_race_before_goes_on(tiles):
    race = _native.Race()
    race.reset(TILE, (0.0, 0.0, 0.0), 0.95)
    with pytest.raises(ValueError):
        race.reset(tiles, (0.0, 0.0, 0.0), 0.95)
    race.step(0, 1, 0)
    assert len(race.tiles()) == 1


@pytest.mark.parametrize("index", [-1, 4, 5])
def test_there_are_four_wheels(index):
    with pytest.raises(IndexError):
        _native.Race().wheel(index)
