"""OpenAI-ES, PEPG and SNES: what their papers say, beside the contract that `test_continuation` holds."""

import numpy as np
import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.addons.optimisers.search_gradients import OpenES, Pepg, Snes
from dreamfleet.coordinator.optimisers.api import Search


def search(population=8, dimension=5, **options):
    return Search(np.zeros(dimension), population, 0.1, seed=3, options=options)


@pytest.mark.parametrize("kind", [OpenES, Pepg])
def test_samples_are_mirrored_and_an_odd_one_out_is_the_mean(kind):
    asked = kind(search(population=7)).ask()
    assert np.array_equal(asked[:3], -asked[3:6])
    assert not asked[6].any()


@pytest.mark.parametrize("kind", [OpenES, Pepg, Snes])
def test_only_the_order_of_fitness_counts_and_a_plateau_moves_nothing(kind):
    one, other, flat = (kind(search()) for _ in range(3))
    for _ in range(5):
        fitness = -np.square(one.ask() - 1).sum(axis=1)
        one.tell(fitness)
        other.ask()
        other.tell(np.exp(fitness))
        flat.ask()
        flat.tell(np.zeros(8))
    assert np.array_equal(one.mean, other.mean)
    assert np.abs(flat.mean).max() < 1e-12


def test_the_first_step_of_adam_is_the_learning_rate():
    optimiser = OpenES(search(learning_rate="0.25"))
    optimiser.tell(optimiser.ask()[:, 0].copy())
    assert optimiser.mean[0] == pytest.approx(0.25, rel=1e-4)


def test_the_step_size_of_openes_stays_unless_it_decays():
    for decay, expected in (("1", 0.1), ("0.5", 0.025)):
        optimiser = OpenES(search(sigma_decay=decay))
        for _ in range(2):
            optimiser.tell(optimiser.ask()[:, 0].copy())
        assert optimiser.sigma == pytest.approx(expected)


@pytest.mark.parametrize("kind", [Pepg, Snes])
def test_deviations_shrink_at_an_optimum_and_grow_on_a_slope(kind):
    sphere, slope = kind(search(population=32)), kind(search(population=32))
    for _ in range(30):
        sphere.tell(-np.square(sphere.ask()).sum(axis=1))
        slope.tell(slope.ask()[:, 0] ** 3)
    assert sphere.sigma < 0.1 < slope._deviations[0] * 1.05


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "fast"])
def test_a_rate_that_is_none_is_refused(text):
    with pytest.raises(UsageError, match="learning_rate"):
        OpenES(search(learning_rate=text))


def test_a_candidate_that_failed_is_drawn_anew_alone():
    optimiser = OpenES(search())
    before = optimiser.ask()
    drawn = optimiser.redraw([2, 5])
    after = optimiser._mean + optimiser._deviations * optimiser._samples
    assert np.array_equal(after[[2, 5]], drawn)
    assert np.array_equal(np.delete(after, [2, 5], axis=0), np.delete(before, [2, 5], axis=0))
