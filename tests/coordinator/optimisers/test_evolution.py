"""Tests evolution.py and pycma.py."""

import numpy as np
import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.evolution import Evolution
from dreamfleet.coordinator.optimisers.pycma import Normals


def build(optimiser="cma", dimension=12, population=8, sigma0=0.1, covariance="diagonal"):
    options = {} if covariance == "diagonal" else {"covariance": covariance}
    return Evolution(optimiser, Search(np.zeros(dimension), population, sigma0, 3, options))


def follow(evolution, generations):
    """Let a search follow an optimum that moves."""
    for generation in generations:
        evolution.tell(-((evolution.ask() - 0.01 * generation) ** 2).sum(axis=1))


@pytest.mark.parametrize("optimiser", ["cma", "cmaes-sep"])
def test_the_step_size_is_how_far_candidates_lie_apart_however_long_a_search_goes_on(optimiser):
    """pycma's own number is above a thousand by then, and a fork would begin with it."""
    evolution = build(dimension=6, population=16, optimiser=optimiser)
    follow(evolution, range(1500))
    apart = (evolution.ask() - evolution.mean).std()
    assert evolution.sigma == pytest.approx(apart, rel=0.5)


@pytest.mark.parametrize(("dimension", "population"), [(6, 4), (400, 16)])  # above 300 pycma steps in another way
def test_a_balanced_search_goes_on_as_it_was(dimension, population):
    one, other = (build(dimension=dimension, population=population) for _ in range(2))
    for evolution in (one, other):
        follow(evolution, range(200))
    other._optimiser._balance()
    for evolution in (one, other):
        follow(evolution, range(200, 210))
    assert np.allclose(other.mean, one.mean, rtol=1e-9, atol=0)
    assert np.allclose(other.ask(), one.ask(), rtol=1e-9, atol=1e-9)


def test_what_is_drawn_ahead_is_not_given_where_pycma_asks_for_another_shape():
    normals, same = Normals(1), Normals(1)
    normals.draw_ahead(4, 2)
    assert np.array_equal(normals(3, 2), same(3, 2))


@pytest.mark.parametrize("fitness", [np.full(8, np.nan), np.zeros(7)])
def test_tell_refuses_what_pycma_would_swallow(fitness):
    evolution = build()
    evolution.ask()
    with pytest.raises(ValueError, match="8"):
        evolution.tell(fitness)


def test_a_state_is_not_taken_while_a_population_is_open():
    evolution = build()
    evolution.ask()
    with pytest.raises(AssertionError):
        evolution.state()


@pytest.mark.parametrize("changes", [{"population": 1}, {"sigma0": 0.0}, {"sigma0": float("nan")}])
def test_impossible_settings_are_refused(changes):
    with pytest.raises(UsageError):
        build(**changes)


@pytest.mark.add_on
@pytest.mark.parametrize("search", [{"covariance": "full"}, {"covariance": "diagonal"}, {"optimiser": "cmaes-sep"},
                                    {"optimiser": "cmaes-lra"}])  # fmt: skip
def test_the_axis_ratio_shows_how_far_from_round_a_search_is(search):
    evolution = build(dimension=4, population=16, **search)
    evolution.ask()
    assert evolution.axis_ratio == pytest.approx(1.0, rel=1e-3)
    steep = np.array([1.0, 1.0, 1.0, 100.0])
    for _ in range(150):
        evolution.tell(-(steep * np.square(evolution.ask() - 1)).sum(axis=1))
    evolution.ask()
    assert 2 < evolution.axis_ratio < 1000
