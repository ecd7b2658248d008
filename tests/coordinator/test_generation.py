import numpy as np
import pytest

from coordinator.generation import Generation
from coordinator.jobs import make_work, travelling
from tests.support.samples import SPEC

VECTORS = [travelling(np.full(5, value)) for value in (0.0, 1.0, 2.0)]


def test_every_candidate_drives_every_seed():
    generation = Generation(4, SPEC, VECTORS, (100, 200))
    jobs = [work.job for work in generation.missing]
    assert [(job.candidate, job.episode, job.seeds) for job in jobs] == [
        (candidate, episode, (seed,)) for candidate in range(3) for episode, seed in enumerate((100, 200))
    ]
    assert len({job.digest for job in jobs}) == generation.total == 6


def test_fitness_is_the_mean_of_a_candidates_own_episodes():
    generation = Generation(0, SPEC, VECTORS, (100, 200))
    for work in reversed(generation.missing):
        generation.record(work.job.digest, work.job.candidate * 10 + work.job.episode, steps=7)
    assert generation.complete
    assert generation.steps == 42
    assert np.array_equal(generation.fitness(), [0.5, 10.5, 20.5])


def test_equal_candidates_share_one_job():
    generation = Generation(0, SPEC, [VECTORS[0], VECTORS[0]], (100,))
    (work,) = generation.missing
    generation.record(work.job.digest, 3.0, steps=1)
    assert generation.complete
    assert np.array_equal(generation.fitness(), [3.0, 3.0])


@pytest.mark.parametrize(
    ("kind", "vector", "seeds"),
    [("evaluate", VECTORS[0], (1,)), ("score", VECTORS[1], (1,)), ("score", VECTORS[0], (2,))],
)
def test_a_digest_is_of_kind_vector_and_seeds(kind, vector, seeds):
    (one,) = make_work(SPEC, "score", 0, 0, VECTORS[0], (1,))
    (other,) = make_work(SPEC, kind, 0, 0, vector, seeds)
    assert one.job.digest != other.job.digest
