import hashlib
from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from dreamfleet.common.protocol.messages import MAX_PART
from dreamfleet.worker.service.outbox import BURST_INTERVAL, MAX_BURST, MAX_ROUND_DELAY, UploadQueue

DIGEST, OTHER = b"\x01" * 32, b"\x02" * 32


def drain(uploads, now, seconds):
    """Everything that leaves from `now` on, with its time."""
    sent = []
    for turn in range(round(seconds / BURST_INTERVAL) + 1):
        sent += [(now + turn * BURST_INTERVAL, piece) for piece in uploads.due(now + turn * BURST_INTERVAL)]
    return sent


@given(st.integers(1, 3 * MAX_PART))
def test_a_round_is_the_whole_file_in_parts(length):
    data = bytes(length)
    uploads = UploadQueue(repeat=100.0)
    uploads.add(DIGEST, data)
    pieces = [piece for _, piece in drain(uploads, 0.0, 1.0)]
    assert b"".join(piece.data for piece in pieces) == data
    assert [piece.offset for piece in pieces] == list(range(0, length, MAX_PART))
    assert {(piece.total, piece.sha256) for piece in pieces} == {(length, hashlib.sha256(data).digest())}


def test_a_large_file_leaves_in_bursts():
    uploads = UploadQueue(repeat=100.0)
    uploads.add(DIGEST, bytes((MAX_BURST + 1) * MAX_PART))
    assert len(uploads.due(0.0)) == MAX_BURST
    assert uploads.due(BURST_INTERVAL / 2) == []
    assert len(uploads.due(BURST_INTERVAL)) == 1


def test_rounds_come_with_longer_and_longer_pauses_until_the_verdict():
    uploads = UploadQueue(repeat=1.0)
    uploads.add(DIGEST, b"drive")
    times = [when for when, _ in drain(uploads, 0.0, 40.0)]
    pauses = [round(after - before) for before, after in pairwise(times)]
    assert pauses == [1, 2, 4, *[MAX_ROUND_DELAY] * 4]
    uploads.acknowledge([DIGEST])
    assert drain(uploads, 100.0, 40.0) == []
    assert len(uploads) == 0


def test_a_new_coordinator_hears_everything_from_the_beginning():
    uploads = UploadQueue(repeat=100.0)
    uploads.add(DIGEST, bytes((MAX_BURST + 1) * MAX_PART))
    uploads.due(0.0)
    uploads.resend_all()
    assert [piece.offset for piece in uploads.due(1.0)] == list(range(0, MAX_BURST * MAX_PART, MAX_PART))


def test_the_verdict_on_one_file_leaves_the_other():
    uploads = UploadQueue(repeat=100.0)
    uploads.add(DIGEST, b"one")
    uploads.add(OTHER, b"other")
    uploads.acknowledge([DIGEST, b"x" * 32])
    assert [piece.data for piece in uploads.due(0.0)] == [b"other"]
