"""The native race is gymnasium's and Box2D's, to the bit: each body, each wheel, tiles, reward and end.
Tests native/*.c. `python -m tests.worker.worlds.car_racing.truth` compares far more."""

import os
import platform
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.worker.worlds.car_racing.environment import is_native_available

if not is_native_available():
    pytest.skip("no native module was built", allow_module_level=True)

from dreamfleet.worker.worlds.car_racing import _native, environment
from dreamfleet.worker.worlds.car_racing.environment import COLOURS, DRAWS
from dreamfleet.worker.worlds.car_racing.reference import Shadow
from tests.worker.worlds.car_racing.truth import (
    MANNERS,
    Ours,
    compare,
    compare_seeds,
    compare_state,
    race_against,
)  # fmt: skip


def pair(**settings):
    """Gymnasium's environment and ours."""
    return Shadow(**settings), Ours(**settings)


def drive(sides, manner, seed, steps, **how):
    """Drive one episode in both; what happened."""
    counts = Counter()
    driver = MANNERS[manner](sides[0], np.random.default_rng(seed))
    assert race_against(*sides, seed, driver, steps, counts, **how) is None
    return counts


@pytest.mark.parametrize("manner", MANNERS)
def test_every_manner_of_driving_gives_the_same_bits(manner):
    drive(pair(), manner, 3, 200)


@pytest.mark.parametrize("settings", [{"domain_randomize": True}, {"continuous": False}])
def test_colours_and_discrete_actions_give_the_same_bits(settings):
    sides = pair(**settings)
    for seed in (7, 8):
        drive(sides, "follow", seed, 60, pictures=20)


def test_tracks_have_the_same_bits():
    assert compare_seeds(range(100, 110)) is None


def test_a_car_at_rest_falls_asleep_and_wakes_as_box2d_lets_it():
    assert drive(pair(), "still", 4, 300)["steps asleep"]


def test_a_lap_ends_the_same():
    assert drive(pair(lap_complete_percent=0.1), "follow", 5, 1500)["laps"]


def test_the_field_ends_the_same_and_is_left_the_same():
    assert drive(pair(), "away", 6, 700, beyond=True)["fields left"]


def test_a_world_that_is_used_again_keeps_the_same_traces():
    sides = pair()
    for seed in range(20, 25):
        drive(sides, "held", seed, 60)


def test_a_car_that_is_put_elsewhere_drives_on_with_the_same_bits():
    sides, action = pair(), np.array([0.2, 0.6, 0.0])
    for each in sides:
        each.reset(seed=9)
    for tile in (0, 40, 41, 120):
        _, beta, x, y = sides[1].track[tile]
        for each in sides:
            each.place(beta + 0.3, x + 1, y - 2)
        for step in range(25):
            paid = [each.step(action)[1] for each in sides]
            assert paid[0] == paid[1]
            assert compare_state(step, sides[0], sides[1].race, tiles=step > 0) is None


@pytest.mark.long
def test_many_steps_tracks_and_pictures_have_the_same_bits():
    """`make proof` sets `PROOF_STEPS` to 3 million: with 1,000 tracks and 300,000 pictures."""
    steps = int(os.environ.get("PROOF_STEPS", "60000"))
    assert compare_seeds(range(steps // 3000)) is None
    counts, difference = compare(steps, seed=77, pictures=10)
    assert difference is None
    assert min(counts[what] for what in ("laps", "fields left", "steps asleep", "pictures")) > 0


def fuses_products():
    """Whether this host's glibc computes sines as those do that the class of hosts is named after."""
    return platform.machine() == "x86_64" and "fma" in Path("/proc/cpuinfo").read_text().split()


@pytest.mark.parametrize("stride", [100_003, pytest.param(11, marks=pytest.mark.long)])
def test_sines_are_glibcs_where_it_fuses_products(tmp_path, stride):
    if platform.libc_ver()[0] != "glibc" or not fuses_products() or not shutil.which("cc"):
        pytest.skip("no compiler, or another host's sines are others")
    folder, program = Path(environment.__file__).with_name("native"), tmp_path / "turns"
    here = Path(__file__).with_name("turns.c")
    flags = ("-std=c11", "-O2", "-mfma", "-ffp-contract=off", "-fno-builtin", f"-I{folder}")
    subprocess.run(["cc", *flags, "-o", program, here, folder / "turn.c", "-lm"], check=True)
    assert subprocess.run([program, str(stride)], check=True, capture_output=True).stdout.split() == [b"0", b"0"]


@pytest.fixture
def race():
    """A native race at its beginning."""
    made, random = _native.Race(), np.random.default_rng(1)
    while not made.reset(random.uniform(*DRAWS), 0.95, np.array(COLOURS)):
        pass
    return made


@pytest.mark.parametrize("action", [(np.nan, 0, 0), (0, np.inf, 0)])
def test_a_step_takes_three_finite_numbers(race, action):
    with pytest.raises(ValueError):
        race.step(*action)
    assert race.step(0, 1, 0)[0] == pytest.approx(1000 / len(race.tiles()) * race.score()[2] - 0.1)


def test_nothing_happens_before_a_reset():
    race = _native.Race()
    for call in (
        race.idle,
        lambda: race.step(0, 0, 0),
        lambda: race.place(0, 0, 0),
        lambda: race.draw(bytearray(12288)),
    ):
        with pytest.raises(ValueError):
            call()
    assert race.track() == race.road() == []


@pytest.mark.parametrize(
    "given",
    [
        (b"", np.zeros(9)),
        (np.full(24, np.nan), np.zeros(9)),
        (np.zeros(24), np.zeros(8)),
        (np.zeros(24), np.full(9, np.inf)),
    ],
)
def test_damaged_numbers_are_refused_and_the_race_before_goes_on(race, given):
    tiles = len(race.tiles())
    with pytest.raises(ValueError):
        race.reset(given[0], 0.95, given[1])
    race.step(0, 1, 0)
    assert len(race.tiles()) == tiles


def test_a_road_that_does_not_close_leaves_the_race_before(race):
    tiles, closed = len(race.tiles()), [race.reset(np.tile((0.0, low), 12), 0.95, np.zeros(9)) for low in (1e-9, 1e9)]
    assert closed == [False, False]
    assert race.step(0, 1, 0)[1] is None
    assert len(race.tiles()) == tiles


@pytest.mark.parametrize("index", [-1, 4, 5])
def test_there_are_four_wheels(index):
    with pytest.raises(IndexError):
        _native.Race().wheel(index)


@pytest.mark.parametrize("place", [(0, np.nan, 0), (np.inf, 0, 0), (0, 0, -2e6)])
def test_a_place_is_near(race, place):
    with pytest.raises(ValueError):
        race.place(*place)


def test_what_cannot_be_drawn_is_a_clear_error(race):
    with pytest.raises(ValueError):
        race.draw(bytearray(5))
    race.place(0, 5e5, 0)
    race.step(1, 1, 0)
    with pytest.raises(ValueError):
        race.draw(bytearray(64 * 64 * 3))
    for time in (-1, np.nan, np.inf):
        with pytest.raises(ValueError):
            race.time = time
