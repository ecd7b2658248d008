import hashlib
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from dreamfleet.common.protocol.codec import encode
from dreamfleet.common.protocol.failures import MAX_CAUSE, Failure
from dreamfleet.common.protocol.messages import MAX_PART, Result, ResultBatch
from dreamfleet.common.schema.validation import MAX_TEXT
from dreamfleet.worker.service.outbox import (
    BURST_INTERVAL,
    MAX_BURST,
    MAX_RESULTS,
    MAX_ROUND_DELAY,
    Outbox,
    UploadQueue,
)
from tests.support.samples import HEAD

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


@given(st.integers(1, 3 * MAX_PART))
def test_a_round_is_the_whole_file_in_parts(length):
    data = bytes(length)
    uploads = UploadQueue(repeat=100.0)
    uploads.add(DIGEST, data)
    parts = [part for _, part in drain(uploads, 0.0, 1.0)]
    assert b"".join(part.data for part in parts) == data
    assert [part.offset for part in parts] == list(range(0, length, MAX_PART))
    assert {(part.total, part.sha256) for part in parts} == {(length, hashlib.sha256(data).digest())}


def test_a_large_file_leaves_in_bursts():
    uploads = UploadQueue(repeat=100.0)
    uploads.add(DIGEST, bytes((MAX_BURST + 1) * MAX_PART))
    assert len(uploads.due(0.0)) == MAX_BURST
    assert uploads.due(BURST_INTERVAL / 2) == []
    assert len(uploads.due(BURST_INTERVAL)) == 1


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
