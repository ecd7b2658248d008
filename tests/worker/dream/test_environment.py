import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dreamfleet.common.artifacts.actions import one_hot
from dreamfleet.common.errors import UsageError
from dreamfleet.worker.dream import CAR_RACING_ENVIRONMENT, ENVIRONMENT
from dreamfleet.worker.dream.environment import Dream, VectorDream, to_rows
from dreamfleet.worker.worldmodel.inference import DreamStep
from tests.support.dreams import ACTIONS, WORLDS, write_bundle_of

ACTION = np.array([0.1, 0.5, 0.0], np.float32)


@pytest.mark.parametrize("features", ["z", "zh"])
def test_gymnasium_accepts_it(random_bundle, features):
    made = gymnasium.make(CAR_RACING_ENVIRONMENT, bundle=random_bundle, render_mode="rgb_array", features=features)
    check_env(made.unwrapped)
    made.reset(seed=1)
    assert made.render().shape == (64, 64, 3)


def test_gymnasium_accepts_the_dream_of_any_world(world, world_bundle):
    made = gymnasium.make(ENVIRONMENT, bundle=world_bundle, render_mode="rgb_array")
    check_env(made.unwrapped)
    assert made.metadata["render_fps"] == (10 if WORLDS[world] else 50)
    assert made.action_space.contains(ACTIONS[world])


def test_a_dream_is_a_function_of_seed_and_actions(random_bundle):
    environment = Dream(random_bundle, horizon=5)

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
    environment, memory = Dream(random_bundle, features="zh"), DreamStep(random_bundle)
    size, state = random_bundle.manifest.latent, memory.zero_state(1)
    seen, _ = environment.reset(seed=3)
    for _ in range(4):
        assert np.array_equal(seen[size:], state[0, : memory.hidden_size])
        state = memory.advance(seen[None, :size], ACTION[None], state)
        seen, *_ = environment.step(ACTION)
    assert seen[size:].any()


@pytest.mark.parametrize("features", ["z", "zh"])
def test_vectorised_dreams_equal_single_ones_and_begin_anew(world, world_bundle, features):
    seeds, made = range(10, 16), {"bundle": world_bundle, "horizon": 6, "features": features}
    many = gymnasium.make_vec(ENVIRONMENT, num_envs=6, vectorization_mode="vector_entry_point", **made)
    assert isinstance(many.unwrapped, VectorDream)
    single, actions = [Dream(**made) for _ in seeds], np.stack([ACTIONS[world]] * 6)
    latents, _ = many.reset(seed=seeds[0])
    assert np.array_equal(latents, [each.reset(seed=seed)[0] for each, seed in zip(single, seeds, strict=True)])
    going, ends = set(range(6)), 0
    for _ in range(6):
        latents, rewards, done, truncated, _ = many.step(actions)
        last = sorted(going)
        for index in last:
            latent, reward, *over, _ = single[index].step(ACTIONS[world])
            assert np.array_equal(latents[index], latent)
            assert (rewards[index], [done[index], truncated[index]]) == (reward, over)
            ends += over[0]
            going -= {index} if any(over) else set()
    assert not going
    assert bool(ends) == bool(WORLDS[world]), "the worlds with a drawn rule end some of their dreams"
    assert not np.stack(many.step(actions)[1:4])[:, last].any(), "those that ended last begin anew"


def test_a_choice_may_be_its_number_or_its_row(choices_bundle):
    environment = Dream(choices_bundle)

    def after(action):
        environment.reset(seed=3)
        return environment.step(action)[0].tobytes()

    rows = np.eye(3, dtype=np.float32)
    assert [after(number) for number in range(3)] == [after(row) for row in rows]
    assert len({after(number) for number in range(3)}) == 3
    assert np.array_equal(to_rows(one_hot(3), [2, 0], 2), rows[[2, 0]])


@pytest.mark.parametrize("action", [3, -1, [0.0, np.nan, 1.0], [1.0, 0.0], 1.0], ids=str)
def test_what_is_no_action_is_refused(choices_bundle, random_bundle, action):
    for bundle in (choices_bundle, random_bundle):
        environment = Dream(bundle)
        environment.reset(seed=1)
        with pytest.raises(ValueError):
            environment.step(action)


def test_a_described_world_dreams_where_its_package_is_missing(tmp_path):
    bundle = write_bundle_of("choices", tmp_path / "b.zip", task="nowhere:Task")
    environment = Dream(bundle)
    environment.reset(seed=1)
    assert environment.step(1)[1] in (0.0, 4.0)


def test_a_dream_is_at_most_as_long_as_an_episode_of_its_world(choices_bundle, random_bundle):
    for bundle, horizon in ((choices_bundle, 200), (random_bundle, 1000)):
        environment = Dream(bundle, end="1.0")  # no probability is above it
        environment.reset(seed=1)
        truncated = [environment.step(environment.action_space.sample())[2:4] for _ in range(horizon)]
        assert truncated == [(False, False)] * (horizon - 1) + [(False, True)]


def test_another_rule_of_the_end_may_be_given(choices_bundle):
    environment = Dream(choices_bundle, end="0.0")
    environment.reset(seed=1)
    assert environment.step(1)[1:3] == (0.0, True)
    with pytest.raises(UsageError, match="'never'"):
        Dream(choices_bundle, end="never")


@pytest.mark.parametrize("temperature", [0.0, -1.0, float("nan"), float("inf")])
def test_an_invalid_temperature_is_refused(random_bundle, temperature):
    with pytest.raises(UsageError):
        Dream(random_bundle, temperature=temperature)
