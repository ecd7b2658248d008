"""An archive of elites: what enters it, what a failed candidate does, and what is refused before a run exists."""

import numpy as np
import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.measures import parse_axes
from dreamfleet.coordinator.addons.quality_diversity.optimisers import CmaMe, MapElites
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.registry import build_optimiser, check_memory

AXES = parse_axes(("x=-1:1:8", "y=-1:1:8"))
BOTH = pytest.mark.parametrize("kind", [CmaMe, MapElites])


def search(dimension=6, population=32, options=None, archive=AXES):
    return Search(np.zeros(dimension), population, 0.3, 1, options or {}, archive)


def run(optimiser, generations, failing=()):
    for generation in range(generations):
        asked = optimiser.ask()
        fitness, measures = -np.square(asked).sum(axis=1), asked[:, :2].copy()
        for row in failing:
            fitness[row], measures[row] = fitness.min() - 1, np.nan
        if generation == 2 and failing:
            measures[:] = np.nan
        optimiser.tell(fitness, measures)


@BOTH
def test_it_fills_the_archive_where_an_optimiser_would_stay_at_the_best(kind):
    optimiser = kind(search())
    run(optimiser, 60)
    measures = optimiser.state()["archive.measures"]
    assert len(measures) >= 50, "of 64 cells"
    assert np.square(optimiser.mean).sum() < 0.3, "the best elite, near the optimum"
    places = {tuple(axis.cell_of(each) for axis, each in zip(AXES, row, strict=True)) for row in measures}
    assert len(places) == len(measures), "a reader of the journal cuts cells where the library does"


@BOTH
def test_a_failed_candidate_enters_no_archive_and_continues_to_the_bit(kind):
    optimiser, again = kind(search()), kind(search())
    run(optimiser, 10, failing=(3, 20))
    again.restore(optimiser.state())
    run(optimiser, 5, failing=(1,))
    run(again, 5, failing=(1,))
    assert np.array_equal(optimiser.ask(), again.ask())
    assert np.isfinite(optimiser.state()["archive.measures"]).all()


def test_a_generation_that_failed_altogether_before_any_elite_changes_nothing():
    optimiser = CmaMe(search())
    optimiser.ask()
    optimiser.tell(np.zeros(32), np.full((32, 2), np.nan))
    assert np.array_equal(optimiser.mean, np.zeros(6))
    run(optimiser, 3)


@BOTH
def test_measures_beyond_the_range_count_as_at_its_end(kind):
    optimiser = kind(search(archive=parse_axes(("x=-1:1:2",))))
    asked = optimiser.ask()
    optimiser.tell(np.zeros(32), np.where(asked[:, :1] > 0, 1e99, -1e99))
    assert sorted(optimiser.state()["archive.measures"].ravel()) == [-1.0, 1.0]


@BOTH
@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"archive": ()}, "--archive"),
        ({"dimension": 10**6, "archive": parse_axes(("x=0:1:100", "y=0:1:100"))}, r"80\.0.*--archive"),
    ],
)
def test_a_search_without_or_with_too_large_an_archive_is_refused(kind, wrong, why):
    with pytest.raises(UsageError, match=why):
        kind(search(**wrong))


@pytest.mark.parametrize("emitters", ["0", "17", "x"])
def test_an_emitter_has_two_candidates_at_least(emitters):
    with pytest.raises(UsageError, match=r"\b16\b"):
        build_optimiser("cma-me", search(options={"emitters": emitters}))


def test_a_population_is_shared_by_emitters():
    optimiser = CmaMe(search(population=33, options={"emitters": "4"}))
    assert optimiser.ask().shape == (33, 6)
    run(optimiser, 2)
    assert sum(name.endswith("random") for name in optimiser.state()) == 5


def test_full_matrices_of_a_large_search_are_refused_before_they_are_built():
    with pytest.raises(UsageError):
        check_memory("cma-me", 10**6, 64, {"covariance": "full"})
    check_memory("cma-me", 10**5, 64, {})
