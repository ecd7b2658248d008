import dataclasses

import numpy as np
import pytest

from dreamfleet.common.artifacts.bundle import RECORDED_STATES, write_bundle
from dreamfleet.common.errors import BundleError, UsageError
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.dream.batch import DreamBatch
from dreamfleet.worker.dream.environment import Dream, VectorDream
from dreamfleet.worker.dream.noise import EpisodeNoise
from dreamfleet.worker.dream.start_states import StartStates
from dreamfleet.worker.dream.world import DreamWorld
from dreamfleet.worker.worldmodel.inference import NoiseSize
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.recurrent_state import RecurrentState
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import npy, states, write_random_bundle
from tests.support.dreams import dreams_of, same_bits
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


def spec(bundle, recorded=0.5, **changes):
    return dataclasses.replace(TaskSpec("dream", bundle.sha256, HORIZON, 0, recorded=recorded), **changes)


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


def test_a_fitness_is_the_same_bits_alone_in_any_batch_and_in_any_order(bundle):
    dreams = dreams_of(bundle, 9, range(6))
    assert len({score.fitness for score in same_bits(bundle, spec(bundle), dreams)}) == len(dreams)


def test_recorded_states_change_only_the_dreams_that_start_there(bundle):
    dreams = dreams_of(bundle, 1, range(40))
    plain, some, all_of_them = (DreamBatch(bundle, spec(bundle, share)).score(dreams) for share in (0.0, 0.5, 1.0))
    same = [a == b for a, b in zip(plain, some, strict=True)]
    assert 8 < sum(same) < 32
    assert all(b == c for a, b, c in zip(same, some, all_of_them, strict=True) if not a)
    assert not any(a == c for a, c in zip(plain, all_of_them, strict=True))


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


@pytest.mark.parametrize("variant", ["plain", "all"])
@pytest.mark.parametrize("memory", MEMORIES)
def test_the_environment_dreams_the_same_bits_with_any_memory(tmp_path, memory, variant):
    rnn = MEMORIES[memory]
    bundle = write_random_bundle(tmp_path / "b.zip", vae=SMALL, rnn=rnn, recorded=states(5, SMALL, rnn))
    bundle = bundle if variant == "plain" else bundle.with_controllers(None, VARIANTS[variant])
    same_bits(bundle, spec(bundle), dreams_of(bundle, 2, range(6)))


def test_in_any_world_dreams_start_at_recorded_states_with_the_same_bits(world_bundle):
    same_bits(world_bundle, spec(world_bundle), dreams_of(world_bundle, 2, range(8)))


@pytest.mark.parametrize(("memory", "reward"), [("rewarded", 0), ("rewarded first", 1)])
def test_an_empty_memory_holds_the_reward_that_training_began_with(tmp_path, memory, reward):
    bundle = write_random_bundle(tmp_path / "b.zip", vae=SMALL, rnn=MEMORIES[memory])
    _, info = Dream(bundle).reset(seed=1)
    assert info["memory"].tolist() == [*[0] * 8, reward]
    assert np.array_equal(info["memory"], RecurrentState(bundle).state[0, :9]), "as in reality"


def test_vectorised_dreams_start_and_restart_as_single_ones(bundle):
    action = np.array([0.1, 0.5, 0.0], np.float32)
    many = VectorDream(6, bundle, horizon=3, recorded=0.5)
    single = [Dream(bundle, horizon=3, recorded=0.5) for _ in range(6)]
    latents, info = many.reset(seed=10)
    assert info["_memory"].all()
    begun = [each.reset(seed=10 + index) for index, each in enumerate(single)]
    assert np.array_equal(latents, [latent for latent, _ in begun])
    assert np.array_equal(info["memory"], [given["memory"] for _, given in begun])
    assert 0 < info["memory"].any(axis=1).sum() < 6
    for _ in range(3):
        latents, _, _, _, given = many.step(np.tile(action, (6, 1)))
        assert np.array_equal(latents, [each.step(action)[0] for each in single])
        assert not given
    _, _, _, _, given = many.step(np.tile(action, (6, 1)))
    assert given["_memory"].all()
    assert 0 < given["memory"].any(axis=1).sum() < 6


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


def test_a_bundle_without_states_is_refused_with_the_remedy(random_bundle):
    with pytest.raises(BundleError, match=r"random\.zip .*`dreamfleet bundle --recorded N`"):
        DreamBatch(random_bundle, spec(random_bundle))
    assert DreamWorld(random_bundle, 1.0).start_states.share == 0


def test_states_of_another_model_are_refused(bundle, tmp_path):
    parts = {name: bundle.read(name) for name in bundle.manifest.parts}
    other = MDNRNNConfig(latent=3, hidden=4, window=2)
    wrong = write_bundle(tmp_path / "w.zip", bundle.manifest, {**parts, RECORDED_STATES: npy(states(2, SMALL, other))})
    with pytest.raises(BundleError, match=r"26 .*14"):
        DreamWorld(wrong, 1.0, recorded=1.0)
    assert DreamWorld(wrong, 1.0).start_states.share == 0, "who begins none there need not be able to"
