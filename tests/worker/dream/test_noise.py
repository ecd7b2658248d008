import numpy as np

from dreamfleet.worker.dream.noise import BLOCK_STEPS, EpisodeNoise, SharedNoise
from dreamfleet.worker.dream.start_states import StartStates
from dreamfleet.worker.worldmodel.inference import NoiseSize

FIRST = np.random.default_rng(0).normal(size=(5, 2, 3)).astype(np.float32)
BEGINNINGS = StartStates(FIRST, np.zeros((0, 6), np.float32))
CHANCE = NoiseSize(3, 4, 0.0)


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
    shared = SharedNoise(np.array([7, 8, 7]), CHANCE, BEGINNINGS, bars_of)
    alone = {seed: EpisodeNoise(seed, CHANCE, bars_of) for seed in (7, 8)}
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
