"""Tests noise.py."""

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import RECORDED_STATES, write_bundle
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.dream.environment import Dream
from dreamfleet.worker.dream.noise import BLOCK_STEPS, EpisodeNoise, SharedNoise
from dreamfleet.worker.dream.start_states import StartStates
from dreamfleet.worker.dream.world import DreamWorld
from dreamfleet.worker.worldmodel.inference import NoiseSize
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import npy, states, write_random_bundle
from tests.support.dreams import dreams_of, same_bits, spec_of
from tests.support.variants import VARIANTS

RANDOM = np.random.default_rng(0)
FIRST = RANDOM.normal(size=(5, 2, 3)).astype(np.float32)
STATES = RANDOM.normal(size=(7, 6 + 4)).astype(np.float32)
CHANCE = NoiseSize(3, 2, 0.0)
HORIZON = 12
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


def spec(bundle, recorded=0.5):
    return spec_of(bundle, HORIZON, recorded=recorded)


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
    assert DreamBatch(without, spec(without, 0.0)).score(dreams) == DreamBatch(bundle, spec(bundle, 0.0)).score(dreams)


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
    assert len({score.fitness for score in same_bits(bundle, spec(bundle), dreams)}) == len(dreams)


@pytest.mark.parametrize("recorded", [0.0, 0.5])
def test_in_any_world_dreams_have_the_same_bits(world_bundle, recorded):
    dreams = dreams_of(world_bundle, 5, range(8))
    assert len(set(same_bits(world_bundle, spec(world_bundle, recorded), dreams))) > 4


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
            DreamBatch(wrong, spec(wrong))
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
