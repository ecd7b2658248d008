"""Every optimiser that ships, and one of a third party, against the same contract; old and damaged states.
Tests api.py, checkpoint.py, evolution.py, pycma.py and pycma_state.py."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

from dreamfleet.common.errors import JournalError, UsageError
from dreamfleet.common.protocol.measures import parse_axes
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint
from dreamfleet.coordinator.optimisers.evolution import Evolution
from dreamfleet.coordinator.optimisers.pycma import Normals
from dreamfleet.coordinator.optimisers.registry import known_optimisers
from tests.support.mutations import Watched, archives

OWN = "tests.support.optimisers:ParentsAndChildren"
OPTIMISERS = [(name, "diagonal") for name in (*known_optimisers(), OWN)] + [("cma", "full"), ("cma-me", "full")]
ARCHIVE = ("first=-2:3:10", "second=-2:3:10")
FILLS_AN_ARCHIVE = ("cma-me", "map-elites")
SIZES = [(2, 4), (31, 7), *(pytest.param(*each, marks=pytest.mark.long) for each in [(3, 64), (12, 5), (50, 16)])]
EVERY_OPTIMISER = pytest.mark.parametrize(("optimiser", "covariance"), OPTIMISERS)


def config(optimiser, covariance="diagonal", dimension=12, population=8, start=None, seed=3):
    archive = parse_axes(ARCHIVE) if optimiser in FILLS_AN_ARCHIVE else ()
    options = {} if covariance == "diagonal" else {"covariance": covariance}
    mean = np.zeros(dimension) if start is None else start
    return optimiser, Search(mean, population, 0.1, seed, options, archive)


def fitness(candidates, generation):
    noise = np.random.default_rng(generation).normal(size=len(candidates))
    return -((candidates - 1.0) ** 2).sum(axis=1) + 0.1 * noise


def step(evolution, generation):
    asked = evolution.ask()
    evolution.tell(fitness(asked, generation), asked[:, :2])
    return asked


def continued(setting, state):
    evolution = Evolution(*setting)
    evolution.restore(state)
    return evolution


def assert_continues(setting, checkpoints, generations):
    """From each checkpoint to the end: the populations, means, step sizes and last state are the same bits."""
    uninterrupted, states, asked = Evolution(*setting), {}, []
    for generation in range(generations):
        if generation in checkpoints:
            states[generation] = uninterrupted.state().packed()
        asked.append(step(uninterrupted, generation))
    for checkpoint, state in states.items():
        again = continued(setting, state)
        for generation in range(checkpoint, generations):
            assert np.array_equal(step(again, generation), asked[generation]), (checkpoint, generation)
        assert np.array_equal(again.mean, uninterrupted.mean)
        assert again.sigma == uninterrupted.sigma
        assert again.state().packed() == uninterrupted.state().packed()


@EVERY_OPTIMISER
@pytest.mark.parametrize(("dimension", "population"), SIZES)
def test_it_asks_the_same_bits_whether_it_was_interrupted_or_not(optimiser, covariance, dimension, population):
    assert_continues(config(optimiser, covariance, dimension, population), (0, 1, 2, 7, 30), 40)


@pytest.mark.parametrize("population", [2, 3, 4, 5])
def test_a_small_population_of_which_pycma_mirrors_some_continues_too(population):
    assert_continues(config("cma", population=population), (0, 1, 2, 7, 20), 30)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("optimiser", "covariance"),
    [("cma", "diagonal"), ("cma", "full"), ("cmaes-lra", "diagonal"), ("cmaes-sep", "diagonal")],
)
@pytest.mark.parametrize(
    ("dimension", "population"),
    [(2, 4), (5, 8), *(pytest.param(*each, marks=pytest.mark.long) for each in [(2, 16), (12, 16), (23, 5), (50, 24)])],
)
def test_it_continues_from_every_generation_up_to_convergence_and_beyond(optimiser, covariance, dimension, population):
    """The step size is next to nothing then. Which arrays pycma's parts share changes as a search stands still."""
    options = {"covariance": "full"} if covariance == "full" else {}
    setting = optimiser, Search(np.ones(dimension), population, 1e-8, 3, options)
    uninterrupted, again = Evolution(*setting), Evolution(*setting)
    for generation in range(200):
        again = continued(setting, again.state().packed())
        for each in (uninterrupted, again):
            each.tell(-((each.ask() - 1) ** 2).sum(axis=1))
        assert again.state().packed() == uninterrupted.state().packed(), generation
    assert np.abs(uninterrupted.mean - 1).max() < 1e-9


@pytest.mark.parametrize("optimiser", ["cma", "cmaes-sep", "cma-me", "map-elites", OWN])
@pytest.mark.parametrize(
    ("dimension", "population"), [(299, 4), (300, 4), (867, 16), pytest.param(900, 64, marks=pytest.mark.long)]
)
def test_it_continues_at_the_real_size(optimiser, dimension, population):
    assert_continues(config(optimiser, "diagonal", dimension, population), (0, 1, 5), 8)


@pytest.mark.parametrize(
    ("dimension", "population"),
    [pytest.param(200, 4, marks=pytest.mark.slow), pytest.param(867, 16, marks=pytest.mark.long)],
)
@pytest.mark.parametrize(("optimiser", "covariance"), [("cma", "full"), ("cmaes-lra", "diagonal")])
def test_a_full_matrix_continues_at_hundreds_of_parameters(optimiser, covariance, dimension, population):
    assert_continues(config(optimiser, covariance, dimension, population), (0, 2), 4)


@EVERY_OPTIMISER
def test_it_maximises_and_the_seed_makes_its_run(optimiser, covariance):
    one, same = (Evolution(*config(optimiser, covariance)) for _ in range(2))
    first = fitness(one.mean[None], 0)
    for generation in range(200):
        assert np.array_equal(step(one, generation), step(same, generation))
    assert fitness(one.mean[None], 0) > first + 5
    other = Evolution(*config(optimiser, covariance, seed=4))
    assert not np.array_equal(other.ask(), Evolution(*config(optimiser, covariance)).ask())


@EVERY_OPTIMISER
def test_it_begins_at_the_given_mean(optimiser, covariance):
    start = np.linspace(-3, 3, 12)
    evolution = Evolution(*config(optimiser, covariance, start=start))
    assert np.array_equal(evolution.mean, start)
    again = continued(config(optimiser, covariance), evolution.state().packed())
    assert np.array_equal(again.mean, start)
    assert np.array_equal(again.ask(), evolution.ask())
    step(evolution, 0)
    assert np.array_equal(start, np.linspace(-3, 3, 12)), "a start belongs to the caller"


@EVERY_OPTIMISER
def test_working_ahead_changes_no_bit(optimiser, covariance):
    ahead, plain = (Evolution(*config(optimiser, covariance)) for _ in range(2))
    for generation in range(5):
        ahead.prepare()
        ahead.prepare()
        assert ahead.state().packed() == plain.state().packed()
        assert np.array_equal(step(ahead, generation), step(plain, generation))


@EVERY_OPTIMISER
def test_a_state_is_arrays_without_pickle_and_holds_mean_and_step_size(optimiser, covariance):
    evolution = Evolution(*config(optimiser, covariance))
    step(evolution, 0)
    kept = evolution.state()
    step(evolution, 1)
    read = Checkpoint.unpack(kept.packed())
    assert all(not array.dtype.hasobject for array in read.state.values())
    assert (read.head.name, read.head.sigma) == (optimiser, kept.head.sigma)
    assert np.array_equal(read.head.mean, kept.head.mean)
    assert not np.array_equal(read.head.mean, evolution.mean), "what was kept stays as it was"


@EVERY_OPTIMISER
def test_a_state_of_another_version_is_refused_with_the_remedy(optimiser, covariance):
    evolution = Evolution(*config(optimiser, covariance))
    kept = evolution.state()
    older = f"{kept.head.requirement.split('==')[0]}==0.0.1"
    changed = Checkpoint(type(kept.head)(optimiser, older, kept.head.mean, kept.head.sigma), kept.state)
    with pytest.raises(JournalError, match=older):
        evolution.restore(changed.packed())


@pytest.mark.add_on
def test_a_state_of_another_optimiser_is_refused():
    with pytest.raises(JournalError, match=r"'cmaes-sep'.* 'cma'"):
        Evolution(*config("cma")).restore(Evolution(*config("cmaes-sep")).state().packed())


GOLDEN = Path(__file__).parents[1] / "golden"
STATE = "pycma-state-of-0.1.npz"


def test_a_state_of_the_first_version_continues_to_the_bit():
    state = (GOLDEN / STATE).read_bytes()
    head = Checkpoint.unpack(state).head
    assert (head.name, head.requirement, head.sigma) == ("cma", "cma==4.5.0", 0.13321928916395698)
    evolution = Evolution("cma", Search(np.zeros(3), 4, 0.1, seed=7))
    evolution.restore(state)
    assert np.array_equal(evolution.ask(), np.load(GOLDEN / "pycma-population-of-0.1.npy"))


def test_a_state_that_says_nothing_of_its_origin_is_refused():
    buffer = BytesIO()
    np.savez(buffer, numbers=np.arange(5))
    with pytest.raises(JournalError):
        Checkpoint.unpack(buffer.getvalue())


@pytest.mark.parametrize("covariance", ["diagonal", "full"])
def test_a_damaged_state_is_restored_or_is_one_line(covariance):
    search, count = Search(np.zeros(4), 6, 0.5, 1, {"covariance": covariance}), 50
    evolution = Evolution("cma", search)
    for _ in range(3):
        evolution.tell((evolution.ask() ** 2).sum(axis=1))
    watched, restored = Watched(), 0
    for data in archives(evolution.state().packed(), count, seed=8):
        restored += watched.read(JournalError, Evolution("cma", search).restore, data)
    watched.check()
    assert 0 < restored < count


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
