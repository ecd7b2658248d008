import numpy as np

from worker.dream.noise import PIECE, Noise, SharedNoise

INITIAL = np.random.default_rng(0).normal(size=(5, 2, 3)).astype(np.float32)


def drawn(seed, steps):
    noise = Noise(seed, 3)
    return [noise.begin(INITIAL), *(each for _ in range(steps) for each in noise.next())]


def test_it_is_a_function_of_the_seed():
    first, again, other = (drawn(seed, 2 * PIECE) for seed in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not any(np.array_equal(a, b) for a, b in zip(first, other, strict=True))


def test_the_choice_of_a_mixture_is_uniform_and_the_rest_normal():
    noise = Noise(3, 1000)
    noise.begin(np.zeros((1, 2, 1000), np.float32))
    uniform, normal = noise.next()
    assert 0 <= uniform.min() < 0.01 < 0.99 < uniform.max() < 1
    assert abs(normal.mean()) < 0.15
    assert 0.9 < normal.std() < 1.1


def test_rows_of_one_seed_share_their_noise_whichever_rows_still_dream():
    shared = SharedNoise(np.array([7, 8, 7, 9]), 3, INITIAL)
    assert np.array_equal(shared.first[0], shared.first[2])
    assert np.array_equal(shared.first[1], drawn(8, 0)[0])
    shared.next(np.arange(4))
    later = shared.next(np.array([1, 2]))
    assert np.array_equal(later.uniform[0], drawn(8, 2)[3])
    assert np.array_equal(later.normal[1], drawn(7, 2)[4])
