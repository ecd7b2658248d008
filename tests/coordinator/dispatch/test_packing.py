import hashlib

import numpy as np
import pytest

from dreamfleet.common.protocol.codec import encode
from dreamfleet.common.protocol.messages import MAX_MESSAGE, JobBatch, Verdict
from dreamfleet.coordinator.dispatch.packing import pack
from dreamfleet.coordinator.jobs.scoring_job import make_jobs, vector_bytes
from tests.support.samples import HEAD, SPEC

RANDOM = np.random.default_rng(0)


def work_of(size, candidates, episodes):
    vectors = [vector_bytes(RANDOM.normal(size=size)) for _ in range(candidates)]
    seeds = range(episodes)
    return [work for index, vector in enumerate(vectors) for work in make_jobs(SPEC, "score", 0, index, vector, seeds)]


def packed(work=(), cancels=(), verdicts=()):
    return pack("a/00000001", 1, work, cancels, verdicts)


def message(content):
    return JobBatch(
        **HEAD, nonce="n", numbering=1, number=1, vectors=tuple(content.vectors),
        jobs=tuple(work.job for work in content.work),
        cancels=tuple(content.cancels), verdicts=tuple(content.verdicts),
    )  # fmt: skip


@pytest.mark.parametrize(("size", "candidates", "episodes"), [(867, 64, 16), (1, 300, 1), (30_000, 3, 2), (11, 1, 1)])
def test_no_batch_is_larger_than_a_message(size, candidates, episodes):
    batches = packed(work_of(size, candidates, episodes), [b"c" * 32] * 500, [Verdict(b"v" * 32, "accepted")] * 900)
    assert all(len(encode(message(batch))) <= MAX_MESSAGE for batch in batches)
    assert sum(len(batch.work) for batch in batches) == candidates * episodes
    assert sum(len(batch.verdicts) for batch in batches) == 900
    assert sum(len(batch.cancels) for batch in batches) == 500


def test_a_vector_is_sent_once_a_batch():
    (batch,) = packed(work_of(100, 2, 3))
    assert len(batch.vectors) == 2
    assert len(batch.work) == 6


def test_a_long_vector_comes_in_parts_before_its_job():
    (work,) = work_of(30_000, 1, 1)
    batches = packed([work])
    received = bytearray()
    for batch in batches:
        for part in batch.vectors:
            assert part.offset == len(received)
            received += part.data
        if batch.work:
            assert hashlib.sha256(received).digest() == work.job.vector
    assert len(batches) == 3


def test_nothing_to_say_is_no_batch():
    assert packed() == []
