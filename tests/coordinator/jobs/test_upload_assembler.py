import hashlib
from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from dreamfleet.common.protocol.messages import MAX_PART, MAX_UPLOAD, UploadPart
from dreamfleet.coordinator.jobs import upload_assembler
from dreamfleet.coordinator.jobs.upload_assembler import MAX_IDLE, UploadAssembler
from tests.support.samples import HEAD

A, B = "a/00000001", "b/00000002"
DIGEST = b"\x01" * 32
DATA = bytes(range(256)) * (2 * MAX_PART // 256) + b"the rest"  # three parts


def sha256(data=DATA):
    return hashlib.sha256(data).digest()


def parts(data=DATA):
    about = HEAD | {"digest": DIGEST, "sha256": sha256(data), "total": len(data)}
    offsets = range(0, len(data), MAX_PART)
    return [UploadPart(**about, offset=offset, data=data[offset : offset + MAX_PART]) for offset in offsets]


@given(st.lists(st.tuples(st.sampled_from([A, B]), st.integers(0, 2)), max_size=30))
def test_whatever_is_lost_doubled_or_late_a_whole_is_the_whole_or_not_there(arrivals):
    uploads, came = UploadAssembler(), {A: set(), B: set()}
    for now, (worker, index) in enumerate(arrivals):
        uploads.add(worker, parts()[index], float(now))
        came[worker].add(index)
        for each, indices in came.items():
            assert uploads.get_complete(each, DIGEST, sha256()) == (DATA if len(indices) == 3 else None)
    for index in range(3):  # the round that comes through
        uploads.add(A, parts()[index], 99.0)
    assert uploads.get_complete(A, DIGEST, sha256()) == DATA
    assert not uploads.dropped
    uploads.forget(DIGEST)
    assert len(uploads) == 0


def test_one_workers_parts_do_not_spoil_anothers_and_a_damaged_upload_is_let_go_and_taken_again():
    uploads = UploadAssembler()
    first, *others = parts()
    uploads.add(B, replace(first, data=bytes(MAX_PART)), 0.0)
    for part in (first, *others):
        uploads.add(A, part, 0.0)
    for part in others:
        uploads.add(B, part, 0.0)
    assert uploads.get_complete(A, DIGEST, sha256()) == DATA
    assert uploads.get_complete(B, DIGEST, sha256()) is None
    for part in (first, *others):
        uploads.add(B, part, 0.0)
    assert uploads.get_complete(B, DIGEST, sha256()) == DATA
    assert uploads.dropped == {"damaged upload": 1}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"total": MAX_UPLOAD + 1}, "upload of a forbidden size"),
        ({"total": 0, "data": b""}, "upload of a forbidden size"),
        ({"offset": 1}, "upload part out of place"),
        ({"offset": 3 * MAX_PART}, "upload part out of place"),
        ({"offset": 2**62}, "upload part out of place"),
        ({"data": b"short"}, "upload part out of place"),
        ({"data": b""}, "upload part out of place"),
    ],
)
def test_a_part_that_cannot_be_one_is_dropped_and_counted(changes, why):
    uploads = UploadAssembler()
    uploads.add(A, replace(parts()[0], **changes), 0.0)
    assert uploads.dropped == {why: 1}
    assert len(uploads) == 0


@given(st.lists(st.tuples(st.integers(0, 20), st.integers(1, MAX_UPLOAD)), max_size=60))
def test_what_unknown_senders_open_is_bounded_in_number_and_size(opened):
    uploads = UploadAssembler()
    for number, total in opened:
        part = replace(
            parts()[0], digest=bytes([number]) * 32, total=total, data=bytes(min(total, MAX_PART)), sha256=bytes(32)
        )
        with patch.multiple(upload_assembler, MAX_OPEN=4, MAX_SIZE=MAX_UPLOAD):
            uploads.add(f"w/{number:08x}", part, 0.0)
        assert len(uploads) <= 4
        assert uploads.size <= MAX_UPLOAD


def test_an_upload_that_stands_still_is_abandoned_and_makes_room(monkeypatch):
    monkeypatch.setattr(upload_assembler, "MAX_OPEN", 1)
    uploads = UploadAssembler()
    first, *others = parts()
    uploads.add(B, first, 0.0)
    uploads.add(A, first, 1.0)
    uploads.tick(MAX_IDLE)
    assert uploads.dropped == {"too many uploads": 1}
    uploads.tick(MAX_IDLE + 0.5)
    for part in (first, *others):
        uploads.add(A, part, MAX_IDLE + 1)
    assert uploads.get_complete(A, DIGEST, sha256()) == DATA
    assert uploads.dropped == {"too many uploads": 1, "abandoned upload": 1}


def test_other_bytes_of_the_same_job_replace_what_was_there():
    uploads = UploadAssembler()
    uploads.add(A, parts()[0], 0.0)
    for part in parts(b"shorter"):
        uploads.add(A, part, 0.0)
    assert uploads.get_complete(A, DIGEST, sha256(b"shorter")) == b"shorter"
    assert uploads.get_complete(A, DIGEST, sha256()) is None
