"""Tests generation.py and scoring_job.py."""

from dataclasses import replace
from math import nan

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dreamfleet.coordinator.jobs import generation as generation_module
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.jobs.scoring_job import vector_bytes
from tests.support.samples import SPEC

DREAM = replace(SPEC, task="dream")
VECTORS = [vector_bytes(np.full(5, value)) for value in (0.0, 1.0, 2.0)]


def test_of_a_dreams_episodes_the_first_are_driven_and_say_so():
    generation = Generation(0, DREAM, VECTORS, (100, 200, 300), driven=1)
    jobs = [work.job for work in generation.missing]
    assert [(job.episode, job.driven) for job in jobs] == [(0, True), (1, None), (2, None)] * 3
    for job in jobs:
        assert job.digest == DREAM.with_overrides(driven=job.driven).digest("score", job.vector, job.seeds)
    assert len({job.digest for job in jobs}) == 9


def test_fitness_is_the_mean_of_a_candidates_own_episodes():
    generation = Generation(0, SPEC, VECTORS, (100, 200))
    for work in reversed(generation.missing):
        generation.record(work.job.digest, work.job.candidate * 10 + work.job.episode, steps=7)
    assert generation.complete
    assert generation.steps == 42
    assert np.array_equal(generation.fitness(), [0.5, 10.5, 20.5])


@pytest.mark.parametrize("racing", [False, True])
def test_made_in_parts_a_generation_has_the_same_jobs_in_the_same_order(monkeypatch, racing):
    monkeypatch.setattr(generation_module, "PART_JOBS", 5)
    whole = Generation(0, SPEC, VECTORS, (100, 200, 300, 400), racing=racing)
    parts = Generation(0, SPEC, VECTORS, (100, 200, 300, 400), racing=racing, in_parts=True)
    offered = parts.missing
    assert (parts.unmade, parts.total, parts.complete) == (4 if racing else 8, whole.total, False)
    for work in offered:  # before the others are made
        parts.record(work.digest, 3.0, steps=1)
    assert not parts.missing
    assert not parts.complete
    while parts.unmade:
        offered += parts.make_more()
    assert [work.job for work in offered] == [work.job for work in whole.missing]
    assert parts.work == whole.work
    for work in offered:
        parts.record(work.digest, 3.0, steps=1)
    assert len(parts.missing) == (4 if racing else 0)


def test_equal_candidates_are_made_at_once(monkeypatch):
    monkeypatch.setattr(generation_module, "PART_JOBS", 1)
    generation = Generation(0, SPEC, [VECTORS[0], VECTORS[1], VECTORS[0]], (100,), in_parts=True)
    assert (generation.unmade, len(generation.work)) == (0, 3)


def race(order, scores):
    """A racing generation of three candidates and three episodes, its first stage answered in this order."""
    generation = Generation(0, SPEC, VECTORS, (100, 200, 300), racing=True)
    first = generation.missing
    opened = [generation.record(first[i].job.digest, scores[first[i].job.candidate], steps=1) for i in order]
    return generation, first, opened


@pytest.mark.parametrize("order", [range(6), reversed(range(6)), (3, 0, 5, 1, 4, 2)])
def test_the_second_half_is_driven_by_the_better_half_after_the_barrier(order):
    generation, first, opened = race(order, [1.0, 5.0, 3.0])
    assert [(work.job.candidate, work.job.episode) for work in first] == [(c, e) for c in range(3) for e in range(2)]
    assert opened == [False] * 5 + [True]
    second = generation.missing
    assert [(work.job.candidate, work.job.episode) for work in second] == [(1, 2), (2, 2)]
    assert not generation.complete
    for work in second:
        assert not generation.record(work.job.digest, 8.0, steps=1)
    assert generation.complete
    assert generation.done == generation.total == 8
    assert np.array_equal(generation.fitness(), [1.0, 6.0, 14 / 3])


def test_of_equals_the_first_go_on():
    generation, _, _ = race(range(6), [2.0, 2.0, 2.0])
    assert [work.job.candidate for work in generation.missing] == [0, 1]


def known(generation, scores):
    """Results of a whole table of scores by digest, a row for each candidate; NaN: it failed for good."""
    return {
        work.digest: (scores[work.template.candidate][work.episode], 7, (float(work.episode),))
        for work in generation.work
    }


def test_what_was_scored_of_a_candidate_below_the_barrier_does_not_count():
    generation = Generation(0, replace(SPEC, measures=("x",)), VECTORS, (1, 2), racing=True)
    generation.recall(known(generation, [[1.0, 9.0], [2.0, 2.0], [3.0, 3.0]]))
    assert generation.complete
    assert generation.fitness().tolist() == [1.0, 2.0, 3.0]
    assert generation.measures().tolist() == [[0.0], [0.5], [0.5]]
    assert (generation.done, generation.total, generation.steps) == (5, 5, 35)
    scores = generation.candidate_scores()
    assert (scores.done, scores.wanted, scores.fitness) == ([1, 2, 2], [1, 2, 2], [1.0, 2.0, 3.0])
    assert generation.surplus == [generation.work[1].digest]
    assert [work.digest for work in generation.counted] == [
        work.digest for work in generation.work if work.digest not in generation.surplus
    ]


def test_a_second_half_that_is_known_before_the_barrier_waits_for_it():
    generation = Generation(0, SPEC, VECTORS, (1, 2), racing=True)
    results = known(generation, [[1.0, nan], [2.0, nan], [3.0, 8.0]])
    first = [work.digest for work in generation.missing]
    generation.recall({digest: each for digest, each in results.items() if digest not in first})
    assert (generation.done, generation.total, generation.steps, generation.failed) == (0, 3, 0, [])
    assert (generation.surplus, generation.counted) == ([], [])
    assert generation.has_failures
    for digest in first:
        assert generation.record(digest, *results[digest]) == (digest == first[-1])
    assert generation.complete
    assert generation.failed == [1], "a failure in the second half counts only above the barrier"
    assert generation.fitness()[[0, 2]].tolist() == [1.0, 5.5]


def test_equal_candidates_have_equal_scores_on_both_sides_of_the_barrier():
    generation = Generation(0, SPEC, [VECTORS[0], VECTORS[0], VECTORS[1]], (1, 2), racing=True)
    results = known(generation, [[3.0, 5.0], [3.0, 5.0], [4.0, 4.0]])
    while generation.missing:
        for work in generation.missing:
            generation.record(work.digest, *results[work.digest])
    assert generation.fitness().tolist() == [4.0, 4.0, 4.0]
    assert (generation.done, generation.total, generation.steps) == (6, 6, 28)


SCORES = st.one_of(st.sampled_from([1.0, 2.0, 3.0]), st.just(nan))


@settings(max_examples=200)
@given(st.data())
def test_a_generation_that_recalls_any_results_in_any_order_is_one_that_was_scored_afresh(data):
    population, episodes = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 4))
    vectors = data.draw(st.lists(st.sampled_from(VECTORS), min_size=population, max_size=population))
    seeds = data.draw(st.lists(st.integers(1, 5), min_size=episodes, max_size=episodes))
    spec, is_raced = replace(SPEC, measures=("x",)), data.draw(st.booleans())
    fresh, recalled = (Generation(0, spec, vectors, seeds, racing=is_raced) for _ in range(2))
    digests = list(dict.fromkeys(work.digest for work in fresh.work))
    results = {digest: (data.draw(SCORES), number, (float(number),)) for number, digest in enumerate(digests)}
    while fresh.missing:
        fresh.record(fresh.missing[0].digest, *results[fresh.missing[0].digest])
    some = data.draw(st.lists(st.sampled_from(digests), unique=True))
    for digest in some[::2]:
        recalled.record(digest, *results[digest])
    recalled.recall({digest: results[digest] for digest in some})
    while recalled.missing:
        digest = data.draw(st.sampled_from(recalled.missing)).digest
        recalled.record(digest, *results[digest])
    for one in (fresh, recalled):
        assert one.complete or one.all_failed
    for facts in ("steps", "done", "total", "failed", "unwanted", "has_bad_seeds", "all_failed"):
        assert getattr(recalled, facts) == getattr(fresh, facts)
    np.testing.assert_array_equal(recalled.fitness(), fresh.fitness())
    np.testing.assert_array_equal(recalled.measures(), fresh.measures())
    assert recalled.candidate_scores() == fresh.candidate_scores()
    assert {work.digest for work in recalled.counted} == {work.digest for work in fresh.counted}
