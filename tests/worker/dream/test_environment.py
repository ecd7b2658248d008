import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dreamfleet.common.errors import UsageError
from dreamfleet.worker.dream import ENVIRONMENT
from dreamfleet.worker.dream.environment import CarRacingDream, CarRacingDreamVector
from dreamfleet.worker.worldmodel.inference import DreamStep

ACTION = np.array([0.1, 0.5, 0.0], np.float32)


@pytest.mark.parametrize("features", ["z", "zh"])
def test_gymnasium_accepts_it(random_bundle, features):
    made = gymnasium.make(ENVIRONMENT, bundle=random_bundle, render_mode="rgb_array", features=features)
    check_env(made.unwrapped)
    made.reset(seed=1)
    assert made.render().shape == (64, 64, 3)


def test_a_dream_is_a_function_of_seed_and_actions(random_bundle):
    environment = CarRacingDream(random_bundle, horizon=5)

    def dream(seed):
        latents = [environment.reset(seed=seed)[0]]
        for step in range(5):
            latent, _, _, truncated, _ = environment.step(ACTION)
            latents.append(latent)
            assert truncated == (step == 4)
        return np.stack(latents)

    first = dream(3)
    assert not np.array_equal(first, dream(4))
    assert np.array_equal(first, dream(3))


def test_the_hidden_state_behind_the_latent_is_what_a_controller_remembers(random_bundle):
    environment, memory = CarRacingDream(random_bundle, features="zh"), DreamStep(random_bundle)
    size, state = random_bundle.manifest.latent, memory.zero_state(1)
    seen, _ = environment.reset(seed=3)
    for _ in range(4):
        assert np.array_equal(seen[size:], state[0, : memory.hidden_size])
        state = memory.advance(seen[None, :size], ACTION[None], state)
        seen, *_ = environment.step(ACTION)
    assert seen[size:].any()


@pytest.mark.parametrize("features", ["z", "zh"])
def test_vectorised_dreams_equal_single_ones(random_bundle, features):
    many = gymnasium.make_vec(
        ENVIRONMENT, num_envs=3, bundle=random_bundle, vectorization_mode="vector_entry_point", horizon=4,
        features=features,
    )  # fmt: skip
    assert isinstance(many.unwrapped, CarRacingDreamVector)
    single = [CarRacingDream(random_bundle, horizon=4, features=features) for _ in range(3)]
    latents, _ = many.reset(seed=10)
    assert np.array_equal(latents, np.stack([each.reset(seed=10 + index)[0] for index, each in enumerate(single)]))
    for _ in range(4):
        latents, rewards, _, truncated, _ = many.step(np.tile(ACTION, (3, 1)))
        steps = [each.step(ACTION) for each in single]
        assert np.array_equal(latents, np.stack([step[0] for step in steps]))
        assert list(rewards) == [step[1] for step in steps]
    assert truncated.all()
    latents, rewards, _, truncated, _ = many.step(np.tile(ACTION, (3, 1)))
    assert not rewards.any()
    assert not truncated.any()


@pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan"), float("inf")])
def test_an_invalid_temperature_is_refused(random_bundle, temperature):
    with pytest.raises(UsageError, match="temperature must be a positive number"):
        CarRacingDream(random_bundle, temperature=temperature)


def test_an_invalid_action_is_refused(random_bundle):
    environment = CarRacingDream(random_bundle)
    environment.reset(seed=1)
    with pytest.raises(ValueError, match="three finite numbers"):
        environment.step(np.array([np.nan, 0, 0]))
