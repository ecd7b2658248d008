"""The true state of car and road: on roads of a known shape, and in the real environment.
CarRacing
through a world model. Tests latent.py, worker/tasks/true_state.py and worker/worldmodel/observation.py."""

import math
from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.dream.environment import Dream
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.tasks.true_state import TaskWithTrueState
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from dreamfleet.worker.worlds.car_racing import LATENT
from dreamfleet.worker.worlds.car_racing.latent import CarRacingLatent
from dreamfleet.worker.worlds.car_racing.native_check import make_car_racing
from dreamfleet.worker.worlds.car_racing.true_state import LOOK_AHEAD, CentreLine, read_true_state, wrap_angle
from tests.support.bundles import write_random_bundle


def stadium(straight=200.0, radius=50.0, step=2.0):
    """Two straights along y, the first from the origin upwards, and two half circles to the left."""
    rows = [(0, 0, 0, y) for y in np.arange(0, straight, step)]
    turns = np.arange(0, math.pi, step / radius)
    rows += [(0, t, -radius + radius * math.cos(t), straight + radius * math.sin(t)) for t in turns]
    rows += [(0, math.pi, -2 * radius, y) for y in np.arange(straight, 0, -step)]
    rows += [(0, math.pi + t, -radius - radius * math.cos(t), -radius * math.sin(t)) for t in turns]
    return CentreLine.of(rows)


def test_a_straight_road_bends_nowhere_and_a_turn_by_its_radius_also_over_the_seam():
    line = stadium()
    np.testing.assert_allclose(line.curvature([20, 100, 180]), 0, atol=1e-12)
    np.testing.assert_allclose(line.curvature([230, 280, 330]), 1 / 50, rtol=1e-3)
    angles = 2 * np.pi * np.arange(200) / 200
    circle = CentreLine.of(np.stack([angles, angles, 50 * np.cos(angles), 50 * np.sin(angles)], axis=1))
    np.testing.assert_allclose(circle.curvature(np.linspace(0, 1000, 77)), 1 / 50, rtol=1e-3)


def test_left_of_a_road_is_positive():
    line = stadium()
    right, middle, left = (line.nearest_position(x, 60.0) for x in (3.0, 0.0, -3.0))
    assert [each.offset for each in (right, middle, left)] == pytest.approx([-3, 0, 3])
    assert left.along == pytest.approx(60)
    assert left.heading == pytest.approx(0)
    assert line.nearest_position(-100 + 3, 60).offset == pytest.approx(3)  # the straight back, towards the inside


@pytest.fixture
def environment():
    made = make_car_racing(preprocessing="box-64")
    made.reset(seed=20_003)
    yield made
    made.close()


def put(environment, tile, aside=0.0, turn=0.0):
    """Move the car beside a track's point, standing still."""
    inner = environment.unwrapped
    _, beta, x, y = inner.track[tile]
    inner.place(beta + turn, x - aside * math.cos(beta), y - aside * math.sin(beta))
    return read_true_state(inner)


@pytest.mark.parametrize("tile", [0, 1, 100, -1])
def test_a_car_on_a_tile_is_on_the_centre_line_or_beside_it_and_turned_to_a_side(environment, tile):
    truth = put(environment, tile)
    assert (truth["lateral_offset"], truth["heading_error"]) == pytest.approx((0, 0), abs=1e-5)
    assert truth["speed"] == truth["yaw_rate"] == truth["side_slip"] == 0
    for sign in (1, -1):  # left and right
        truth = put(environment, tile, aside=4 * sign, turn=0.3 * sign)
        assert truth["lateral_offset"] == pytest.approx(4 * sign, rel=0.1)
        assert truth["heading_error"] == pytest.approx(0.3 * sign, abs=0.15)


def test_bends_ahead_are_those_of_the_tracks_own_points(environment):
    track = np.array(environment.unwrapped.track)
    turned = wrap_angle(track[2:, 1] - track[:-2, 1]) / 7.0  # two steps of 3.5 metres
    curvature = np.array([put(environment, tile)["curvature_5m"] for tile in range(len(track) - 2)])
    assert np.corrcoef(curvature[:-2], turned[1:-1])[0, 1] > 0.95
    assert curvature.mean() > 0  # a lap turns to the left as a whole


def drive(environment, actions):
    """The true states of a drive from the start, after the opening zoom."""
    states = []
    for action in actions:
        environment.step(np.array(action, np.float32))
        states.append(read_true_state(environment.unwrapped))
    return states


@pytest.mark.parametrize("side", [1, -1])
def test_steering_turns_wheels_car_and_offset_to_one_side(environment, side):
    put(environment, 5)
    states = drive(environment, [(0, 0.5, 0)] * 20 + [(-0.4 * side, 0.2, 0)] * 25)  # negative steering is left
    last = states[-1]
    assert last["speed"] > 5
    for name in ("wheel_angle", "yaw_rate", "heading_error", "lateral_offset"):
        assert last[name] * side > 0, name


def test_side_slip_is_speed_to_the_left(environment):
    put(environment, 30)
    hull = environment.unwrapped.car.hull
    sine, cosine = math.sin(hull.angle), math.cos(hull.angle)
    hull = hull._replace(linearVelocity=(-10 * sine - 3 * cosine, 10 * cosine - 3 * sine))
    car = environment.unwrapped.car._replace(hull=hull)
    truth = read_true_state(SimpleNamespace(car=car, track=environment.unwrapped.track))
    assert (truth["side_slip"], truth["speed"]) == pytest.approx((3, math.hypot(10, 3)), rel=1e-5)


def test_full_gas_straight_on_leaves_the_road_for_good(environment):
    states = drive(environment, [(0, 1, 0)] * 200)
    off = [each["off_road"] for each in states]
    assert off[:20] == [0] * 20
    assert off[-1] == 1
    assert abs(states[-1]["lateral_offset"]) > 40 / 6  # half a road's width


def test_every_step_has_the_same_names_in_both_environments(environment):
    task = find_task("car-racing")
    assert isinstance(task, TaskWithTrueState)
    assert not isinstance(find_task("gym:CartPole-v1"), TaskWithTrueState)
    judge = make_car_racing(preprocessing="raw-96")
    judge.reset(seed=20_003)
    assert task.truth(judge) == task.truth(environment)
    assert {f"curvature_{distance}m" for distance in LOOK_AHEAD} < set(task.truth(judge))
    judge.close()


FIRST, STEPS = 20_000, 12
SMALL = VAEConfig(latent=4, channels=(4, 4, 8, 8))
MODELS = {
    "rewarded": (SMALL, MDNRNNConfig(latent=4, hidden=6, reward="value", previous_reward=True)),
    "attentive": (SMALL, MDNRNNConfig(latent=4, hidden=6, window=3, attention_units=4)),
    "whole": (replace(SMALL, picture=96), MDNRNNConfig(latent=4, hidden=6)),
}


@pytest.fixture
def small(tmp_path):
    return write_random_bundle(tmp_path / "small.zip", 0, *MODELS["rewarded"])


def steered(environment, actions):
    outputs = [environment.reset(seed=FIRST)]
    outputs += [environment.step(action) for action in actions]
    environment.close()
    return np.stack([each[0] for each in outputs]), [each[1:] for each in outputs]


@pytest.mark.parametrize("features", ["z", "zh"])
def test_gymnasium_accepts_it_and_the_dream_has_its_spaces(small, features):
    made = gymnasium.make(LATENT, bundle=small, features=features)
    check_env(made.unwrapped, skip_render_check=True)  # gymnasium's own renders
    dream = Dream(small, features=features)
    assert made.observation_space == dream.observation_space
    assert made.action_space == dream.action_space


@pytest.mark.parametrize("model", MODELS)
def test_it_shows_what_controllers_see_and_gives_what_they_earn_to_the_bit(model, tmp_path):
    bundle = write_random_bundle(tmp_path / "model.zip", 0, *MODELS[model])
    task, assignment = find_task("car-racing"), Assignment.of("car-racing", bundle)
    policy, judge = task.make_policy(assignment), task.make_evaluation_environment(assignment)
    policy.begin(np.random.default_rng(0).normal(size=bundle.controller_shape.size).astype(np.float32))
    picture, _ = judge.reset(seed=FIRST)
    seen, actions, given = [], [], []
    for _ in range(STEPS):
        before = policy.state[0, : bundle.manifest.hidden]
        actions.append(policy.act(picture))
        seen.append(np.concatenate([policy.latent[0], before]))
        picture, *rest = judge.step(actions[-1])
        policy.reward(rest[0])
        given.append(tuple(rest))
    judge.close()
    for native in (False, True):
        observed, outputs = steered(CarRacingLatent(bundle, "zh", native=native), actions)
        assert observed[:-1].tobytes() == np.stack(seen).tobytes()
        assert outputs[1:] == given
    latents, _ = steered(CarRacingLatent(bundle), actions)
    assert np.array_equal(latents, observed[:, : bundle.manifest.latent])
    assert np.ptp(latents, axis=0).all()


def test_an_episode_is_gymnasiums_whole_one(small):
    _, outputs = steered(gymnasium.make(LATENT, bundle=small, native=True), np.zeros((1000, 3), np.float32))
    assert [each[2] for each in outputs[1:]] == [False] * 999 + [True]
    assert not any(each[1] for each in outputs[1:])


def test_what_is_no_action_or_no_features_is_refused(small):
    environment = CarRacingLatent(small)
    environment.reset(seed=FIRST)
    with pytest.raises(ValueError):
        environment.step(np.array([0, np.nan, 0]))
    environment.close()
    for make in (CarRacingLatent, Dream):
        with pytest.raises(UsageError, match="'h'"):
            make(small, features="h")
