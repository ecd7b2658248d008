"""Disturbed drives with the true state beside the world model's. Tests subject.py."""

from dataclasses import replace
from functools import partial
from itertools import islice

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import write_bundle
from dreamfleet.common.errors import ControllerError, UsageError
from dreamfleet.worker.addons.inspection.disturbed_rollouts import (
    OFF,
    DisturbedDriveConfig,
    first_sustained,
    record_disturbed_drives,
)
from dreamfleet.worker.addons.inspection.subject import make_controller_actor, make_driver_actors
from dreamfleet.worker.scoring.actors import ControllerActor
from dreamfleet.worker.scoring.episode import EpisodeConfig, run_episode
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.training.data.collect_config import known_drivers
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.tasks import TOY

SMALL, RNN = VAEConfig(latent=5, channels=(4, 4, 4, 8)), MDNRNNConfig(latent=5, hidden=8)


def drives(bundle, actors, **config):
    recurrent = RecurrentState(bundle)
    config = DisturbedDriveConfig(**config)
    return record_disturbed_drives(bundle, recurrent, lambda seed: actors(recurrent, seed), config)


def drive(bundle, actors, **config):
    return next(drives(bundle, actors, **config))


def drivers(name, bundle):
    actors = make_driver_actors(bundle, name)
    return lambda _recurrent, seed: actors(seed)


def test_without_noise_a_controller_drives_as_its_policy_does(tiny, controller):
    task, assignment = find_task("car-racing"), Assignment.of("car-racing", tiny)
    policy, environment = task.make_policy(assignment), task.make_environment(assignment)
    policy.begin(controller.parameters)
    moments = list(run_episode(environment, policy, EpisodeConfig(20_002, 60)))
    environment.close()

    def actor(recurrent, _seed):
        return ControllerActor(controller, tiny, recurrent)

    seen = drive(tiny, actor, noise=0, steps=60, first_seed=20_002)
    np.testing.assert_allclose(seen.action, [each.action for each in moments], atol=1e-5)
    assert seen.reward.tolist() == [each.reward for each in moments]
    assert seen.features.shape == (60, 32 + 256)
    np.testing.assert_allclose(seen.latent[-1], policy.latent[0], atol=1e-5)
    assert (seen.state[0] == 0).all()


def test_a_drive_ends_behind_its_loss_and_is_a_function_of_its_seed(tiny):
    one, other = (drive(tiny, drivers("held", tiny), noise=1.0, after=30) for _ in range(2))
    assert one.lost is not None
    assert len(one) == one.lost + 30
    assert one.truth[OFF][one.lost - 1] == 0
    assert (one.truth[OFF][one.lost : one.lost + 10] == 1).all()
    assert np.array_equal(one.state, other.state)
    assert np.array_equal(one.action, other.action)


def test_a_controller_of_another_world_model_drives_by_its_own(tiny, controller, tmp_path):
    def watched_by(bundle, recurrent, _seed):
        return make_controller_actor(controller, tiny, bundle, recurrent)

    watching = write_random_bundle(tmp_path / "small.zip", vae=SMALL, rnn=RNN)
    watched, driven = (drive(each, partial(watched_by, each), noise=0.1, steps=30) for each in (watching, tiny))
    assert watched.features.shape == (30, 13)
    assert np.array_equal(watched.action, driven.action)
    whole = replace(SMALL, picture=96, padding="same")
    other = write_random_bundle(tmp_path / "whole.zip", vae=whole, rnn=RNN)
    with pytest.raises(ControllerError, match=r"box-64.*car-racing.*raw-96"):
        make_controller_actor(controller, tiny, other, RecurrentState(other))


def test_all_drivers_of_data_sets_drive_for_a_probe_and_no_others(tiny):
    for name in ("random", *known_drivers()):
        assert drive(tiny, drivers(name, tiny), steps=3).action.shape == (3, 3)
    with pytest.raises(UsageError, match="'ghost'"):
        make_driver_actors(tiny, "ghost")


@pytest.mark.parametrize(
    ("off", "first"), [("0111010", 1), ("0110110", -1), ("1110111", 0), ("0000111", 4), ("0000000", -1), ("11", -1)]
)
def test_a_road_is_lost_where_the_car_is_off_it_for_long_enough(off, first):
    assert first_sustained(np.array([[each == "1" for each in off]]), 3).tolist() == [first]


def test_tracks_follow_each_other(tiny):
    one, other = islice(drives(tiny, drivers("held", tiny), steps=3, first_seed=20_007), 2)
    assert (one.seed, other.seed) == (20_007, 20_008)
    assert not np.array_equal(one.latent, other.latent)


def test_a_driver_that_never_comes_far_begins_anywhere(tiny):
    start, one, other = (
        drive(tiny, drivers("held", tiny), steps=2, first_seed=20_000, anywhere=each).truth["lateral_offset"][0]
        for each in (False, True, True)
    )
    assert abs(start) < 0.01 < abs(one)
    assert one == other


def test_a_world_without_true_state_is_reported(tmp_path):
    ours = write_random_bundle(tmp_path / "ours.zip", vae=SMALL, rnn=RNN)
    parts = {name: ours.read(name) for name in ours.manifest.parts}
    toy = write_bundle(tmp_path / "toy.zip", replace(ours.manifest, task=TOY), parts)
    with pytest.raises(UsageError):
        drive(toy, drivers)
