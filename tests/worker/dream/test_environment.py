"""Dreams step by step and in batches. Tests batch.py, noise.py, start_states.py and task.py."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dreamfleet import Scorer
from dreamfleet.common.artifacts.actions import one_hot
from dreamfleet.common.artifacts.bundle import RECORDED_STATES, write_bundle
from dreamfleet.common.artifacts.world_facts import EndRule
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.worker.dream import CAR_RACING_ENVIRONMENT, ENVIRONMENT
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.dream.environment import Dream, VectorDream, to_rows
from dreamfleet.worker.dream.noise import BLOCK_STEPS, EpisodeNoise, SharedNoise
from dreamfleet.worker.dream.start_states import StartStates
from dreamfleet.worker.dream.world import DreamWorld
from dreamfleet.worker.scoring import episode
from dreamfleet.worker.scoring.episode import EpisodeConfig
from dreamfleet.worker.worldmodel.inference import DreamStep, NoiseSize
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import npy, states, write_random_bundle
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
    environment = Dream(choices_bundle, end="0.0")
    environment.reset(seed=1)
    assert environment.step(1)[1:3] == (0.0, True), "and as short as its rule says"


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


RANDOM = np.random.default_rng(0)
FIRST = RANDOM.normal(size=(5, 2, 3)).astype(np.float32)
STATES = RANDOM.normal(size=(7, 6 + 4)).astype(np.float32)
CHANCE = NoiseSize(3, 2, 0.0)
BRIEF = 12
SMALL = VAEConfig(latent=3, channels=(2, 2, 2, 2))
PLAIN = MDNRNNConfig(latent=3, hidden=4)


def begun(seed, share):
    """The first latent, the memory, and the noise of the first step."""
    noise = EpisodeNoise(seed, CHANCE)
    latent, memory = noise.begin(StartStates(FIRST, STATES, share))
    return latent, memory, noise.next().normal[0]


@pytest.fixture
def bundle(tmp_path):
    return write_random_bundle(tmp_path / "b.zip", vae=SMALL, rnn=PLAIN, recorded=states(9, SMALL, PLAIN))


def begun_spec(bundle, recorded=0.5):
    return spec_of(bundle, BRIEF, recorded=recorded)


def test_the_configured_share_of_dreams_starts_at_recorded_states():
    for share in (0.0, 0.25, 1.0):
        recorded = np.mean([begun(seed, share)[1].any() for seed in range(400)])
        assert abs(recorded - share) < 0.06 * (0 < share < 1) + 1e-9


def test_every_recorded_state_is_used_with_its_memory():
    memories = {begun(seed, 1.0)[1].tobytes() for seed in range(200)}
    assert memories == {state[6:].tobytes() for state in STATES}
    spread = np.stack([begun(seed, 1.0)[0] for seed in range(200) if (begun(seed, 1.0)[1] == STATES[2, 6:]).all()])
    assert (abs(spread.mean(0) - STATES[2, :3]) < 3 * np.exp(0.5 * STATES[2, 3:6]) / np.sqrt(len(spread))).all()


def test_a_dream_from_a_first_picture_is_the_same_at_every_share():
    for seed in range(50):
        plain, some = begun(seed, 0.0), begun(seed, 0.4)
        assert not plain[1].any()
        assert np.array_equal(plain[2], some[2]), "the noise of its steps is the same wherever it begins"
        if some[1].any():
            assert all(np.array_equal(a, b) for a, b in zip(some, begun(seed, 0.8), strict=True))
        else:
            assert np.array_equal(plain[0], some[0])


def test_with_share_zero_recorded_states_change_nothing(bundle, tmp_path):
    without = write_random_bundle(tmp_path / "without.zip", vae=SMALL, rnn=PLAIN)
    dreams = dreams_of(bundle, 3, range(5))
    assert DreamBatch(without, begun_spec(without, 0.0)).score(dreams) == DreamBatch(
        bundle, begun_spec(bundle, 0.0)
    ).score(dreams)


MEMORIES = {
    "plain": PLAIN,
    "ending": MDNRNNConfig(latent=3, hidden=4, done=True),
    "rewarded": MDNRNNConfig(latent=3, hidden=4, previous_reward=True),
    "rewarded first": MDNRNNConfig(latent=3, hidden=4, previous_reward=True, first_reward=1.0),
    "dropout": MDNRNNConfig(latent=3, hidden=4, dropout=0.2),
    "attentive": MDNRNNConfig(latent=3, hidden=4, window=3, attention_units=4),
}


@pytest.mark.parametrize("memory", MEMORIES)
def test_the_environment_dreams_the_same_bits_with_any_memory(tmp_path, memory):
    rnn = MEMORIES[memory]
    plain = write_random_bundle(tmp_path / "b.zip", vae=SMALL, rnn=rnn, recorded=states(5, SMALL, rnn))
    bundle = plain.with_controllers(None, VARIANTS["all"])
    dreams = dreams_of(bundle, 2, range(6))
    assert len({score.fitness for score in same_bits(bundle, begun_spec(bundle), dreams)}) == len(dreams)


@pytest.mark.parametrize("recorded", [0.0, 0.5])
def test_in_any_world_dreams_have_the_same_bits(world_bundle, recorded):
    dreams = dreams_of(world_bundle, 5, range(8))
    assert len(set(same_bits(world_bundle, begun_spec(world_bundle, recorded), dreams))) > 4


@pytest.mark.parametrize(("memory", "reward"), [("rewarded", 0), ("rewarded first", 1)])
def test_an_empty_memory_holds_the_reward_that_training_began_with(tmp_path, memory, reward):
    bundle = write_random_bundle(tmp_path / "b.zip", vae=SMALL, rnn=MEMORIES[memory])
    _, info = Dream(bundle).reset(seed=1)
    assert info["memory"].tolist() == [*[0] * 8, reward]
    assert np.array_equal(info["memory"], RecurrentState(bundle).state[0, :9]), "as in reality"


def test_a_memory_that_was_given_may_be_changed(bundle):
    environment = Dream(bundle, recorded=1.0)
    first = environment.reset(seed=1)[1]["memory"]
    kept = first.copy()
    first[:] = 7
    assert np.array_equal(environment.reset(seed=1)[1]["memory"], kept)


@pytest.mark.parametrize("share", [-0.1, 1.1, float("nan")])
def test_an_invalid_share_is_refused(bundle, share):
    with pytest.raises(UsageError):
        DreamWorld(bundle, 1.0, recorded=share)


def test_no_states_or_those_of_another_model_are_refused_where_dreams_begin_there(random_bundle, bundle, tmp_path):
    parts = {name: bundle.read(name) for name in bundle.manifest.parts}
    recorded = npy(states(2, SMALL, MDNRNNConfig(latent=3, hidden=4, window=2)))
    other = write_bundle(tmp_path / "other.zip", bundle.manifest, {**parts, RECORDED_STATES: recorded})
    for wrong, named in ((random_bundle, r"random\.zip .*`dreamfleet bundle --recorded N`"), (other, r"26 .*14")):
        with pytest.raises(BundleError, match=named):
            DreamBatch(wrong, begun_spec(wrong))
        assert DreamWorld(wrong, 1.0).start_states.share == 0


PICTURES = np.random.default_rng(0).normal(size=(5, 2, 3)).astype(np.float32)
BEGINNINGS = StartStates(PICTURES, np.zeros((0, 6), np.float32))
SMALL_CHANCE = NoiseSize(3, 4, 0.0)


def test_the_choice_of_a_mixture_is_uniform_and_the_rest_normal():
    noise = EpisodeNoise(3, NoiseSize(1000, 1, 0.0))
    noise.begin(StartStates(np.zeros((1, 2, 1000), np.float32), np.zeros((0, 2000), np.float32)))
    draw = noise.next()
    assert 0 <= draw.uniform.min() < 0.01 < 0.99 < draw.uniform.max() < 1
    assert abs(draw.normal.mean()) < 0.15
    assert 0.9 < draw.normal.std() < 1.1
    assert draw.mask is None


def bars_of(uniform):
    return uniform.astype(np.float32)


def test_drawn_ends_have_their_own_numbers_so_that_all_others_stay():
    chance = NoiseSize(3, 4, 0.25)
    plain, drawing = EpisodeNoise(7, chance), EpisodeNoise(7, chance, bars_of)
    assert np.array_equal(plain.begin(BEGINNINGS).latent, drawing.begin(BEGINNINGS).latent)
    bars = []
    for _ in range(2 * BLOCK_STEPS):
        without, draw = plain.next(), drawing.next()
        assert without.bar is None
        for name in ("uniform", "normal", "mask"):
            assert np.array_equal(getattr(without, name), getattr(draw, name))
        bars.append(draw.bar)
    assert np.shape(bars) == (2 * BLOCK_STEPS, 1, 1)
    assert len(np.unique(bars)) == 2 * BLOCK_STEPS


def test_rows_of_one_seed_share_noise_and_bars_whichever_rows_still_dream():
    shared = SharedNoise(np.array([7, 8, 7]), SMALL_CHANCE, BEGINNINGS, bars_of)
    alone = {seed: EpisodeNoise(seed, SMALL_CHANCE, bars_of) for seed in (7, 8)}
    first = {seed: noise.begin(BEGINNINGS).latent for seed, noise in alone.items()}
    assert np.array_equal(shared.first.latent, [first[7], first[8], first[7]])
    for rows in ([0, 1, 2], [1, 2], [2]):
        found, draws = shared.next(np.array(rows)), {seed: noise.next() for seed, noise in alone.items()}
        for name in ("uniform", "normal", "bar"):
            wanted = [getattr(draws[8 if row == 1 else 7], name)[0] for row in rows]
            assert np.array_equal(getattr(found, name), wanted)
    assert not np.array_equal(draws[7].normal, draws[8].normal)


def test_dropout_keeps_the_mean_and_is_shared_too():
    chance = NoiseSize(3, 1000, 0.25)
    shared, alone = SharedNoise(np.array([7, 8]), chance, BEGINNINGS), EpisodeNoise(8, chance)
    alone.begin(BEGINNINGS)
    mask = shared.next(np.array([1])).mask
    assert np.array_equal(mask, alone.next().mask)
    assert set(np.unique(mask)) == {np.float32(0), np.float32(1) / np.float32(0.75)}
    assert abs(mask.mean() - 1) < 0.1
