"""Tests evolution.py and pycma.py."""

import numpy as np
import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.optimisers.evolution import Evolution, EvolutionConfig
from dreamfleet.coordinator.optimisers.pycma import Normals


def config(**changes):
    settings = {"dimension": 12, "population": 8, "sigma0": 0.1, "covariance": "diagonal", "seed": 3}
    return EvolutionConfig(**{**settings, **changes})


def noisy_sphere(candidates, generation):
    noise = np.random.default_rng(generation).normal(size=len(candidates))
    return -((candidates - 1.0) ** 2).sum(axis=1) + 0.1 * noise


def sphere(candidates, _generation):
    return -((candidates - 1.0) ** 2).sum(axis=1)


def run(evolution, generations, fitness=noisy_sphere):
    for generation in generations:
        evolution.tell(fitness(evolution.ask(), generation))


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
@pytest.mark.parametrize("checkpoint", [0, 1, 7, 40])
def test_a_continued_strategy_equals_one_that_never_stopped(covariance, checkpoint):
    uninterrupted = Evolution(config(covariance=covariance))
    run(uninterrupted, range(60))

    first = Evolution(config(covariance=covariance))
    run(first, range(checkpoint))
    second = Evolution(config(covariance=covariance))
    second.restore(first.state().packed())
    run(second, range(checkpoint, 60))

    assert np.array_equal(second.mean, uninterrupted.mean)
    assert second.sigma == uninterrupted.sigma
    assert np.array_equal(second.ask(), uninterrupted.ask())


@pytest.mark.parametrize("population", [2, 3, 4, 5])
def test_a_small_population_of_which_pycma_mirrors_some_continues_too(population):
    uninterrupted, restarted = Evolution(config(population=population)), Evolution(config(population=population))
    for generation in range(30):
        run(uninterrupted, [generation])
        state = restarted.state().packed()
        restarted = Evolution(config(population=population))
        restarted.restore(state)
        run(restarted, [generation])
        assert np.array_equal(restarted.mean, uninterrupted.mean)


@pytest.mark.parametrize("checkpoint", [0, 1, 5])
def test_a_checkpoint_continues_at_the_real_size(checkpoint):
    uninterrupted, first = (Evolution(config(dimension=867, population=16)) for _ in range(2))
    run(uninterrupted, range(10))
    run(first, range(checkpoint))
    second = Evolution(config(dimension=867, population=16))
    second.restore(first.state().packed())
    run(second, range(checkpoint, 10))
    assert np.array_equal(second.mean, uninterrupted.mean)


@pytest.mark.slow
@pytest.mark.parametrize("covariance", ["diagonal", "full"])
@pytest.mark.parametrize(
    ("dimension", "population"),
    [(2, 4), (5, 8), *(pytest.param(*each, marks=pytest.mark.long) for each in [(2, 16), (12, 16), (23, 5), (50, 24)])],
)
def test_a_strategy_continues_from_every_generation_up_to_convergence_and_beyond(dimension, population, covariance):
    """pycma's parts share some arrays; which ones changes as a strategy stands still."""
    setting = config(dimension=dimension, population=population, covariance=covariance, sigma0=1e-8)
    uninterrupted, steps = Evolution(setting, start=np.full(dimension, 1.0)), []
    for generation in range(100):
        state = uninterrupted.state().packed()
        run(uninterrupted, [generation], sphere)
        continued = Evolution(setting)
        continued.restore(state)
        run(continued, [generation], sphere)
        assert continued.state().packed() == uninterrupted.state().packed(), generation
        steps.append(uninterrupted.sigma)
    assert min(steps) < 1e-9, "below what pycma takes for movement"


def following(candidates, generation):
    return -((candidates - 0.01 * generation) ** 2).sum(axis=1)


@pytest.mark.parametrize("optimiser", ["cma", "cmaes-sep"])
def test_the_step_size_is_how_far_candidates_lie_apart_however_long_a_search_goes_on(optimiser):
    """pycma's own number is above a thousand by then, and a fork would begin with it."""
    evolution = Evolution(config(dimension=6, population=16, optimiser=optimiser))
    run(evolution, range(1500), following)
    apart = (evolution.ask() - evolution.mean).std()
    assert evolution.sigma == pytest.approx(apart, rel=0.5)


@pytest.mark.parametrize(("dimension", "population"), [(6, 4), (400, 16)])  # above 300 pycma steps in another way
def test_a_balanced_search_goes_on_as_it_was(dimension, population):
    one, other = (Evolution(config(dimension=dimension, population=population)) for _ in range(2))
    for evolution in (one, other):
        run(evolution, range(200), following)
    other._optimiser._balance()
    for evolution in (one, other):
        run(evolution, range(200, 210), following)
    assert np.allclose(other.mean, one.mean, rtol=1e-9, atol=0)
    assert np.allclose(other.ask(), one.ask(), rtol=1e-9, atol=1e-9)


def test_asking_again_from_a_state_gives_the_same_population():
    evolution = Evolution(config())
    run(evolution, range(3))
    state = evolution.state().packed()
    asked = evolution.ask()
    other = Evolution(config())
    other.restore(state)
    assert np.array_equal(other.ask(), asked)


def test_what_is_drawn_ahead_changes_no_number():
    ahead, plain = Evolution(config()), Evolution(config())
    for generation in range(5):
        ahead.prepare()
        ahead.prepare()
        assert ahead.state().packed() == plain.state().packed()
        run(ahead, [generation])
        run(plain, [generation])
    assert np.array_equal(ahead.mean, plain.mean)
    normals, same = Normals(1), Normals(1)
    normals.draw_ahead(4, 2)
    assert np.array_equal(normals(3, 2), same(3, 2)), "pycma may ask for another shape"


def test_it_maximises():
    evolution = Evolution(config())
    run(evolution, range(200))
    assert np.abs(evolution.mean - 1).max() < 0.3


def test_the_seed_makes_the_run():
    one, same, other = Evolution(config()), Evolution(config()), Evolution(config(seed=4))
    assert np.array_equal(one.ask(), same.ask())
    assert not np.array_equal(one.ask(), other.ask())


@pytest.mark.parametrize("fitness", [np.full(8, np.nan), np.zeros(7)])
def test_tell_refuses_what_pycma_would_swallow(fitness):
    evolution = Evolution(config())
    evolution.ask()
    with pytest.raises(ValueError, match="8"):
        evolution.tell(fitness)


def test_a_state_is_not_taken_while_a_population_is_open():
    evolution = Evolution(config())
    evolution.ask()
    with pytest.raises(AssertionError):
        evolution.state()


@pytest.mark.parametrize("changes", [{"population": 1}, {"sigma0": 0.0}, {"sigma0": float("nan")}])
def test_impossible_settings_are_refused(changes):
    with pytest.raises(UsageError):
        config(**changes)


@pytest.mark.parametrize("search", [{"covariance": "full"}, {"covariance": "diagonal"}, {"optimiser": "cmaes-sep"},
                                    {"optimiser": "cmaes-lra"}])  # fmt: skip
def test_the_axis_ratio_shows_how_far_from_round_a_search_is(search):
    evolution = Evolution(config(dimension=4, population=16, **search))
    evolution.ask()
    assert evolution.axis_ratio == pytest.approx(1.0, rel=1e-3)
    steep = np.array([1.0, 1.0, 1.0, 100.0])
    for _ in range(150):
        evolution.tell(-(steep * np.square(evolution.ask() - 1)).sum(axis=1))
    evolution.ask()
    assert 2 < evolution.axis_ratio < 1000
