"""CarRacing through a world model: gymnasium's environment with the observations of controllers and dreams.
Tests worker/worldmodel/observation.py."""

from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.dream.environment import Dream
from dreamfleet.worker.tasks.api import Assignment
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from dreamfleet.worker.worlds.car_racing import LATENT
from dreamfleet.worker.worlds.car_racing.latent import CarRacingLatent
from tests.support.bundles import write_random_bundle

SEED, STEPS = 20_000, 12
SMALL = VAEConfig(latent=4, channels=(4, 4, 8, 8))
MODELS = {
    "rewarded": (SMALL, MDNRNNConfig(latent=4, hidden=6, reward="value", previous_reward=True)),
    "attentive": (SMALL, MDNRNNConfig(latent=4, hidden=6, window=3, attention_units=4)),
    "whole": (replace(SMALL, picture=96), MDNRNNConfig(latent=4, hidden=6)),
}


@pytest.fixture
def small(tmp_path):
    return write_random_bundle(tmp_path / "small.zip", 0, *MODELS["rewarded"])


def drive(environment, actions):
    outputs = [environment.reset(seed=SEED)]
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
    picture, _ = judge.reset(seed=SEED)
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
        observed, outputs = drive(CarRacingLatent(bundle, "zh", native=native), actions)
        assert observed[:-1].tobytes() == np.stack(seen).tobytes()
        assert outputs[1:] == given
    latents, _ = drive(CarRacingLatent(bundle), actions)
    assert np.array_equal(latents, observed[:, : bundle.manifest.latent])
    assert np.ptp(latents, axis=0).all()


def test_an_episode_is_gymnasiums_whole_one(small):
    _, outputs = drive(gymnasium.make(LATENT, bundle=small, native=True), np.zeros((1000, 3), np.float32))
    assert [each[2] for each in outputs[1:]] == [False] * 999 + [True]
    assert not any(each[1] for each in outputs[1:])


def test_what_is_no_action_or_no_features_is_refused(small):
    environment = CarRacingLatent(small)
    environment.reset(seed=SEED)
    with pytest.raises(ValueError):
        environment.step(np.array([0, np.nan, 0]))
    environment.close()
    for make in (CarRacingLatent, Dream):
        with pytest.raises(UsageError, match="'h'"):
            make(small, features="h")
