"""The optimisers from `cmaes` against the library's own loop."""

import cmaes
import numpy as np
import pytest

from dreamfleet.coordinator.addons.optimisers.cmaes_library import ExponentialNes, RateAdapted, Separable
from dreamfleet.coordinator.optimisers.api import Search

LAMBDA = 8


@pytest.mark.parametrize("dimension", [2, 3, 17, 64, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", [ExponentialNes, RateAdapted, Separable])
def test_it_is_the_library_to_the_bit(kind, dimension):
    start = np.linspace(-1, 1, dimension)
    settings = {"seed": 3, "population_size": LAMBDA}
    ours = kind(Search(start, LAMBDA, 0.1, 3))
    if kind is RateAdapted:
        theirs = cmaes.CMA(start.copy(), 0.1, lr_adapt=True, **settings)
    else:
        strategy = cmaes.XNES if kind is ExponentialNes else cmaes.SepCMA
        theirs = strategy(start.copy(), 0.1, **settings)
    for _ in range(15):
        asked, expected = ours.ask(), np.stack([theirs.ask() for _ in range(LAMBDA)])
        assert np.array_equal(asked, expected)
        cost = np.round(((asked - 1) ** 2).sum(axis=1), 1)  # with ties, which keep their order
        ours.tell(-cost)
        theirs.tell(list(zip(expected, cost.tolist(), strict=True)))
    assert np.array_equal(ours.mean, theirs._mean)


@pytest.mark.parametrize("kind", [ExponentialNes, RateAdapted, Separable])
def test_a_seed_of_more_than_the_librarys_bits_is_folded(kind):
    folded, own = (kind(Search(np.zeros(4), LAMBDA, 0.1, seed)).ask() for seed in (2**40 + 5, 5))
    assert np.array_equal(folded, own)
