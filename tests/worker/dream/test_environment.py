"""Dreams step by step and in batches. Tests batch.py and task.py."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dreamfleet import Scorer, UsageError
from dreamfleet.common.artifacts.actions import one_hot
from dreamfleet.common.artifacts.world_facts import EndRule
from dreamfleet.worker.dream import CAR_RACING_ENVIRONMENT, ENVIRONMENT
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.dream.environment import Dream, VectorDream, to_rows
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import EpisodeConfig
from dreamfleet.worker.worldmodel.inference import DreamStep
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.dreams import ACTIONS, WORLDS, DreamPolicy, dreams_of, same_bits, spec_of, write_bundle_of
from tests.support.variants import VARIANTS

ACTION = np.array([0.1, 0.5, 0.0], np.float32)


@pytest.mark.parametrize("features", ["z", "zh"])
def test_gymnasium_accepts_the_dream_of_any_world(world, world_bundle, features):
    made = gymnasium.make(ENVIRONMENT, bundle=world_bundle, render_mode="rgb_array", features=features)
    check_env(made.unwrapped)
    made.reset(seed=1)
    assert made.render().shape == (64, 64, 3)
    assert made.metadata["render_fps"] == (10 if WORLDS[world] else 50)
    assert made.action_space.contains(ACTIONS[world])
    assert gymnasium.spec(CAR_RACING_ENVIRONMENT).entry_point == made.spec.entry_point


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
    made = {"bundle": world_bundle, "horizon": 6, "features": features, "recorded": 0.5}
    many = gymnasium.make_vec(ENVIRONMENT, num_envs=6, vectorization_mode="vector_entry_point", **made)
    assert isinstance(many.unwrapped, VectorDream)
    single, actions = [Dream(**made) for _ in range(6)], np.stack([ACTIONS[world]] * 6)
    latents, info = many.reset(seed=10)
    begun = [each.reset(seed=10 + index) for index, each in enumerate(single)]
    assert np.array_equal(latents, [latent for latent, _ in begun])
    assert np.array_equal(info["memory"], [given["memory"] for _, given in begun])
    assert 0 < info["memory"].any(axis=1).sum() < 6, "some begin at recorded states"
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
    _, *rest, info = many.step(actions)
    assert not np.stack(rest)[:, last].any(), "those that ended last begin anew"
    assert info["_memory"][last].all()


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


@pytest.mark.parametrize(
    "setting", [{"end": "never"}, *({"temperature": t} for t in (0.0, -1.0, np.nan, np.inf))], ids=str
)
def test_no_rule_and_no_temperature_are_refused(choices_bundle, setting):
    with pytest.raises(UsageError):
        Dream(choices_bundle, **setting)


HORIZON = 20


def spec(bundle, **changes):
    return spec_of(bundle, **{"horizon": HORIZON, "temperature": 1.3, **changes})


def test_a_fitness_is_the_same_bits_alone_in_any_batch_in_any_order_and_by_an_episode(random_bundle):
    dreams = dreams_of(random_bundle, 20, (1, 2, 3))
    found = same_bits(random_bundle, spec(random_bundle), dreams)
    assert len({score.fitness for score in found}) == len(dreams)
    environment, (vector, seed) = Dream(random_bundle, temperature=1.3, horizon=HORIZON), dreams[-1]
    driven = episode.score(environment, DreamPolicy(random_bundle), vector, EpisodeConfig(seed, HORIZON))
    assert driven == found[-1]


def test_a_run_dreams_in_a_described_world_and_its_host_class_is_of_the_drawn_ends_too(choices_bundle, monkeypatch):
    asked = spec(choices_bundle, horizon=100)
    scorer = Scorer(asked, choices_bundle)
    assert Scorer(asked, choices_bundle).host_class == scorer.host_class
    for vector, seed in dreams_of(choices_bundle, 2, (3,)):
        score = scorer.score("score", vector, seed=seed)
        assert [score] == DreamBatch(choices_bundle, asked).score([(vector, seed)])
        assert 1 < score.steps < 100
    bars = EndRule.bars
    monkeypatch.setattr(EndRule, "bars", lambda *given, **named: bars(*given, **named) * np.float32(0.2))
    assert Scorer(asked, choices_bundle).host_class != scorer.host_class


def test_rows_that_end_do_not_change_the_others(tmp_path):
    rnn = MDNRNNConfig(latent=3, hidden=4, done=True)
    plain = write_random_bundle(tmp_path / "b.zip", 5, VAEConfig(latent=3, channels=(2, 2, 2, 2)), rnn)
    bundle = plain.with_controllers(None, VARIANTS["all"])
    found = same_bits(bundle, spec(bundle, temperature=3.0), dreams_of(bundle, 20, range(3)))
    assert len({score.steps for score in found}) > 2


def test_steps_are_reported_as_they_are_made_and_an_invalid_vector_is_refused(random_bundle):
    dreaming, reported = DreamBatch(random_bundle, spec(random_bundle)), []
    dreams = dreams_of(random_bundle, 3, (1,))
    dreaming.score(dreams, reported.append)
    assert reported == [3 * step for step in range(1, HORIZON + 1)]
    (vector, _), *_ = dreams
    vector[3] = np.nan
    for wrong in (vector, vector[:-1]):
        with pytest.raises(UsageError):
            dreaming.score([(wrong, 1)])
