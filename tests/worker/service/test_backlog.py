"""What waits on its way into a worker and out of it. Tests outbox.py."""

import hashlib
from itertools import pairwise

import pytest
from msgspec.structs import replace

from dreamfleet.common.protocol.codec import encode
from dreamfleet.common.protocol.failures import MAX_CAUSE, Failure
from dreamfleet.common.protocol.messages import MAX_LEASES, MAX_PART, Result, ResultBatch, VectorPart
from dreamfleet.common.schema.validation import MAX_TEXT
from dreamfleet.worker.service import backlog as room
from dreamfleet.worker.service.backlog import DAMAGED, MAX_BATCHES_AHEAD, MAX_UNUSED_VECTORS, Backlog
from dreamfleet.worker.service.outbox import (
    BURST_INTERVAL,
    MAX_BURST,
    MAX_RESULTS,
    MAX_ROUND_DELAY,
    Outbox,
    UploadQueue,
)
from tests.support.samples import HEAD, SPEC, VECTOR, WHOLE, batch, job


def test_jobs_come_out_in_order_up_to_a_number_and_drives_between_dreams_up_to_their_own():
    backlog = Backlog(SPEC)
    drives = [job(number, driven=True) for number in (1, 3, 5)]
    evaluation = job(6, "evaluate")
    backlog.add_batch(batch(1, (job(0), drives[0], job(2), evaluation, drives[1], job(4), drives[2], job(7))))
    taken = [[each for each, _ in backlog.take(3, 2)] for _ in range(6)]
    assert taken == [[job(0), job(2), job(4)], drives[:2], [evaluation], drives[2:], [job(7)], []]


def test_a_repeated_batch_counts_once_and_seen_is_the_highest_number_without_a_gap():
    backlog, seen = Backlog(SPEC), []
    for number in (1, 1, 3, 4, 2):
        backlog.add_batch(batch(number, (job(number),)))
        seen.append(backlog.seen)
    assert seen == [1, 1, 1, 1, 4]
    assert [each.episode for each, _ in backlog.take(9)] == [1, 3, 4, 2]
    backlog.add_batch(batch(1, (job(1),)))
    assert not backlog.take(1)


def test_parts_of_a_vector_may_arrive_in_batches_in_any_order():
    backlog = Backlog(SPEC)
    first, second = (replace(WHOLE, offset=at, data=VECTOR[at : at + 32]) for at in (0, 32))
    backlog.add_batch(batch(2, (job(0),), (second,)))
    assert not backlog.take(1)
    backlog.add_batch(batch(1, (), (first,)))
    assert backlog.take(1) == [(job(0), VECTOR)]


def test_neither_a_cancelled_job_nor_one_that_a_slot_has_is_started():
    backlog = Backlog(SPEC)
    backlog.add_batch(batch(1, (job(0), job(1), job(2))), {job(0).digest})
    backlog.add_batch(batch(2, cancels=(job(1).digest,)))
    assert backlog.take(5) == [(job(2), VECTOR)]


def test_a_job_with_the_digest_of_other_content_is_refused():
    backlog, short = Backlog(SPEC), job(1, horizon=400, patience=0)
    changes = ({"seeds": (5,)}, {"horizon": None}, {"horizon": 401}, {"patience": 1})
    wrong = [replace(short, **each) for each in changes]
    assert backlog.add_batch(batch(1, (short, *wrong))) == [(each, DAMAGED) for each in wrong]
    assert backlog.take(5) == [(short, VECTOR)]


def test_jobs_taken_together_have_one_stage():
    named = ({}, {}, {"horizon": 400}, {"horizon": 400}, {"horizon": 400, "patience": 5}, {"patience": 5})
    backlog = Backlog(SPEC)
    backlog.add_batch(batch(1, (job(episode, **each) for episode, each in enumerate(named))))
    assert [[each.episode for each, _ in backlog.take(5)] for _ in range(5)] == [[0, 1], [2, 3], [4], [5], []]


def test_the_oldest_vectors_that_no_job_needs_are_dropped():
    backlog = Backlog(SPEC)
    for number in range(1, 500):
        data = number.to_bytes(8, "little")
        part = replace(WHOLE, id=hashlib.sha256(data).digest(), shape=(2,), data=data)
        backlog.add_batch(batch(number, vectors=(part,)))
    assert len(backlog._vectors) <= MAX_UNUSED_VECTORS


def test_a_new_numbering_counts_from_one():
    backlog = Backlog(SPEC)
    backlog.add_batch(batch(1, (job(0),)))
    backlog.start_numbering(1)
    backlog.clear()
    assert not backlog.take(1)
    backlog.add_batch(batch(1, (job(1),)))
    assert backlog.take(1) == [(job(1), VECTOR)]


def test_a_batch_number_far_ahead_is_ignored():
    backlog = Backlog(SPEC)
    for number in (MAX_BATCHES_AHEAD + 1, 2**40, 2**62):
        backlog.add_batch(batch(number, (job(0),)))
    assert not backlog.queued
    assert not backlog._received_ahead
    backlog.add_batch(batch(1, (job(1),)))
    assert backlog.seen == 1


def test_jobs_beyond_the_limit_are_dropped():
    backlog = Backlog(SPEC)
    for number in range(3):
        backlog.add_batch(batch(number + 1, (job(number * 500 + each) for each in range(500))))
    assert len(backlog.queued) == MAX_LEASES
    backlog.clear()
    backlog.add_batch(batch(4, (job(0),)))
    assert backlog.take(1) == [(job(0), VECTOR)]


def test_bytes_of_vectors_are_limited(monkeypatch):
    monkeypatch.setattr(room, "MAX_VECTOR_BYTES", 4 * MAX_PART)
    backlog = Backlog(SPEC)
    for number in range(100):
        rubbish = VectorPart(id=bytes([number]) * 32, dtype="<f4", shape=(2**40,), offset=0, data=bytes(MAX_PART))
        backlog.add_batch(batch(number + 1, vectors=(rubbish,)))
    assert len(backlog._vectors) == 4
    backlog.add_batch(batch(101, (job(0),)))
    assert not backlog.queued, "it is given again, to a worker with room"


def test_jobs_of_a_corrupted_vector_are_dropped_and_can_be_given_again():
    backlog = Backlog(SPEC)
    backlog.add_batch(batch(1, vectors=(replace(WHOLE, data=bytes(64)),)))
    backlog.add_batch(batch(2, (job(0), job(1))))
    assert not backlog.take(2)
    assert not backlog.queued
    backlog.add_batch(batch(3, (job(0),)))
    assert backlog.take(2) == [(job(0), VECTOR)]


DIGEST, OTHER = b"\x01" * 32, b"\x02" * 32


def result(number):
    return Result(number.to_bytes(32, "little"), 1.0, 10, 0.1, None, None)


def test_a_result_is_due_at_once_and_again_until_its_verdict_less_and_less_often():
    outbox = Outbox(repeat=1.0)
    outbox.add(result(1))
    assert outbox.due(0.0) == [(result(1),)]
    assert outbox.due(0.5) == []
    outbox.acknowledge([b"x" * 32])
    assert outbox.due(1.0) == [(result(1),)]
    assert 6 < sum(len(outbox.due(1 + second / 10)) for second in range(600)) < 12
    outbox.acknowledge([result(1).digest])
    assert outbox.due(99.0) == []
    assert len(outbox) == 0


def test_many_results_and_long_errors_are_cut_into_messages():
    outbox, long = Outbox(repeat=1.0), Failure("ü" * MAX_TEXT, "ü" * MAX_CAUSE, "usage")
    for number in range(MAX_RESULTS + 5):
        outbox.add(result(number))
    assert [len(results) for results in outbox.due(0.0)] == [MAX_RESULTS, 5]
    for number in range(200):
        outbox.add(replace(result(number), fitness=None, error=long))
    messages = [ResultBatch(**HEAD, fingerprint="f" * MAX_TEXT, results=results) for results in outbox.due(0.0)]
    assert sum(len(each.results) for each in messages) == 200
    assert all(map(encode, messages))


def test_a_new_coordinator_gets_every_result_again_and_every_file_from_its_beginning():
    outbox, uploads = Outbox(repeat=100.0), UploadQueue(repeat=100.0)
    outbox.add(result(1))
    uploads.add(DIGEST, bytes((MAX_BURST + 1) * MAX_PART))
    for waiting in (outbox, uploads):
        waiting.due(0.0)
        waiting.resend_all()
    assert outbox.due(0.1) == [(result(1),)]
    assert [part.offset for part in uploads.due(1.0)] == list(range(0, MAX_BURST * MAX_PART, MAX_PART))


def drain(uploads, now, seconds):
    """Everything that is sent from `now` on, with its time."""
    sent = []
    for turn in range(round(seconds / BURST_INTERVAL) + 1):
        sent += [(now + turn * BURST_INTERVAL, part) for part in uploads.due(now + turn * BURST_INTERVAL)]
    return sent


@pytest.mark.parametrize("length", [1, MAX_PART, MAX_BURST * MAX_PART + 1])
def test_a_round_is_the_whole_file_in_parts_and_leaves_in_bursts(length):
    uploads, data = UploadQueue(repeat=100.0), bytes(length)
    uploads.add(DIGEST, data)
    parts = uploads.due(0.0)
    assert uploads.due(BURST_INTERVAL / 2) == []
    assert len(parts) == min(-(-length // MAX_PART), MAX_BURST)
    parts += uploads.due(BURST_INTERVAL)
    assert b"".join(part.data for part in parts) == data
    assert [part.offset for part in parts] == list(range(0, length, MAX_PART))
    assert {(part.total, part.sha256) for part in parts} == {(length, hashlib.sha256(data).digest())}


def test_rounds_come_with_longer_and_longer_pauses_until_the_verdict_on_that_file():
    uploads = UploadQueue(repeat=1.0)
    uploads.add(DIGEST, b"drive")
    times = [when for when, _ in drain(uploads, 0.0, 40.0)]
    pauses = [round(after - before) for before, after in pairwise(times)]
    assert pauses == [1, 2, 4, *[MAX_ROUND_DELAY] * 4]
    uploads.add(OTHER, b"other")
    uploads.acknowledge([DIGEST, b"x" * 32])
    assert {part.data for _, part in drain(uploads, 100.0, 40.0)} == {b"other"}
    assert len(uploads) == 1
