"""The codec and the golden fixtures: each message as its protocol version first wrote it, each document for ever.

`python -m tests.common.protocol.test_codec` writes a new message's fixture; it never writes one that exists.

Tests messages.py.
"""

import dataclasses
import gc
import json
import tracemalloc
from pathlib import Path

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace as changed

from dreamfleet.common.protocol.codec import CountingDecoder, decode, decode_json, encode, encode_json, encoding
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.keys import PROTOCOL_VERSION
from dreamfleet.common.protocol.messages import MAX_MESSAGE, Heartbeat, HelloRequest, JobBatch, Message, ResultBatch
from dreamfleet.common.schema.validation import SCHEMA, MalformedError
from tests.support.mutations import mutations
from tests.support.samples import JSON, MSGPACK, VECTOR_ID

GOLDEN = Path(__file__).parents[1] / "golden"


@pytest.mark.parametrize("name", MSGPACK)
def test_golden_messages_decode(name):
    sample, payload = MSGPACK[name], (GOLDEN / f"{name}.v{PROTOCOL_VERSION}.msgpack").read_bytes()
    assert decode(type(sample), payload) == sample
    assert encode(sample) == payload


@pytest.mark.parametrize("name", JSON)
def test_golden_documents_decode_for_ever(name):
    sample, payload = JSON[name], (GOLDEN / f"{name}.v1.json").read_bytes()
    assert decode_json(type(sample), payload) == sample
    assert encode_json(sample) == payload


def test_every_wire_message_has_a_fixture():
    assert {type(sample) for sample in MSGPACK.values()} == set(Message.__subclasses__())


def test_the_encoding_names_the_schema():
    assert encoding(JobBatch) == "application/msgpack;dreamfleet.job.v2"


def damaged(name="result", **changes):
    raw = msgpack.unpackb(encode(MSGPACK[name]))
    raw.update(changes)
    return msgpack.packb(raw)


def result_with(**changes):
    raw = msgpack.unpackb(encode(MSGPACK["result"]))
    raw["results"][0].update(changes)
    return msgpack.packb(raw)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "not msgpack"),
        (b"\xc1", "not msgpack"),
        (b"\xde\xff\xff", "not msgpack"),
        (b"\xdd\xff\xff\xff\xff", "not msgpack"),
        (b"\x91" * 5000, "not msgpack"),
        (msgpack.packb([1]), "not a message"),
        (msgpack.packb({1: 2}), "not msgpack"),
        (damaged(v=1), "unknown version"),
        (damaged(v=None), "unknown version"),
        (damaged(extra=1), SCHEMA),
        (damaged(run_uid="short"), SCHEMA),
        (damaged(run_uid=b"0" * 32), SCHEMA),
        (damaged(incarnation=-1), SCHEMA),
        (damaged(incarnation=True), SCHEMA),
        (damaged(incarnation=2**63), SCHEMA),
        (damaged(results={}), SCHEMA),
        (damaged(results=[None]), SCHEMA),
        (result_with(fitness=float("nan")), SCHEMA),
        (result_with(fitness=float("inf")), SCHEMA),
        (result_with(fitness="1"), SCHEMA),
        (result_with(digest=b"\x01" * 31), SCHEMA),
        (result_with(error={"text": "x" * 3000, "cause": "x"}), SCHEMA),
        (result_with(error={"text": "x", "cause": ""}), SCHEMA),
        (result_with(error={"text": "x", "cause": "x", "kind": "odd"}), SCHEMA),
        (result_with(error="x"), SCHEMA),
        (damaged("beat", queued=[b"abcdefgh"] * 2000), SCHEMA),
        (damaged("view", height=0), SCHEMA),
        (b"\x00" * (MAX_MESSAGE + 1), "oversize"),
    ],
)
def test_malformed_messages_are_dropped_and_counted(payload, reason):
    kinds = {"queued": Heartbeat, "height": type(MSGPACK["view"])}
    kind = next((kind for word, kind in kinds.items() if word.encode() in payload), ResultBatch)
    inbox = CountingDecoder()
    assert inbox.decode(kind, payload) is None
    assert inbox.dropped == {reason: 1}


def test_a_default_is_not_written_whichever_object_it_is():
    result = MSGPACK["result"].results[1]
    payloads = {
        encode(changed(MSGPACK["result"], results=(changed(result, error=Failure("x", "y", kind)),)))
        for kind in ("other", "".join(("ot", "her")))
    }
    assert len(payloads) == 1


def test_the_log_has_the_first_fault_alone(caplog):
    caplog.set_level("INFO")
    inbox = CountingDecoder()
    for _ in range(3):
        assert inbox.decode(ResultBatch, damaged(extra=1)) is None
    assert len(caplog.records) == 1
    assert "extra" in caplog.text


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (changed(MSGPACK["job"], vectors=MSGPACK["job"].vectors * 2000), "oversize"),
        (changed(MSGPACK["beat"], load=float("nan")), SCHEMA),
        (changed(MSGPACK["beat"], seen=2**63 - 1), SCHEMA),
    ],
)
def test_messages_are_checked_before_encoding(message, reason):
    with pytest.raises(MalformedError) as caught:
        encode(message)
    assert caught.value.reason == reason


def test_hello_ignores_fields_of_later_versions():
    plain = encode_json(JSON["hello-request"]).replace(b"{", b'{"hat_size": 7, ', 1)
    assert decode_json(HelloRequest, plain) == JSON["hello-request"]


@pytest.mark.parametrize("payload", [b"", b"[]", b"{}", b"{" * 20000, b'{"protocol_min": NaN}', b"\xff"])
def test_malformed_documents_are_dropped_and_counted(payload):
    inbox = CountingDecoder()
    assert inbox.decode_json(HelloRequest, payload) is None
    assert inbox.dropped.total() == 1


@given(st.binary(max_size=200))
def test_random_bytes_never_raise_past_the_inbox(payload):
    inbox = CountingDecoder()
    assert all(inbox.decode(kind, payload) is None for kind in Message.__subclasses__())


@given(st.data())
def test_mutated_messages_decode_or_are_counted(data):
    name = data.draw(st.sampled_from(sorted(MSGPACK)))
    payload = bytearray(encode(MSGPACK[name]))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    inbox = CountingDecoder()
    message = inbox.decode(type(MSGPACK[name]), bytes(payload))
    assert (message is None) == (inbox.dropped.total() == 1)


def test_vectors_round_trip_to_the_bit():
    vector = np.array([0.0, -0.0, 1e-45, 3.4e38], dtype="<f4")
    part = changed(MSGPACK["job"].vectors[0], id=VECTOR_ID, shape=(4,), data=vector.tobytes())
    received = decode(JobBatch, encode(changed(MSGPACK["job"], vectors=(part,))))
    assert received.vectors[0].data == vector.tobytes()


def decode_all(count, seed):
    inbox, good = CountingDecoder(), 0
    kinds = list(MSGPACK.values())
    for number, payload in enumerate(mutations(count, seed)):
        good += inbox.decode(type(kinds[number % len(kinds)]), payload) is not None
    return inbox, good


def test_damaged_messages_never_raise_and_are_all_counted():
    inbox, good = decode_all(20_000, seed=1)
    assert sum(inbox.dropped.values()) + good == 20_000


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_a_million_damaged_messages_never_raise_are_all_counted_and_leave_nothing_behind():
    decode_all(1000, seed=2)
    tracemalloc.start()
    held = []
    for count, seed in ((200_000, 3), (400_000, 4), (400_000, 5)):
        inbox, good = decode_all(count, seed)
        assert sum(inbox.dropped.values()) + good == count
        assert len(inbox.dropped) < 20
        del inbox
        gc.collect()
        held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    # The interpreter's table of names grows by megabytes, but once: a leak would grow in each part.
    assert min(held[1] - held[0], held[2] - held[1]) < 100_000


def test_half_a_surrogate_pair_is_malformed():
    hello = JSON["hello-request"]
    with pytest.raises(MalformedError):
        decode_json(HelloRequest, json.dumps({**dataclasses.asdict(hello), "fingerprint": "\ud800"}).encode())
    with pytest.raises(MalformedError):
        encode_json(dataclasses.replace(hello, fingerprint="\ud800"))
    whole = dataclasses.replace(hello, fingerprint="ä \U0001f697")
    assert decode_json(HelloRequest, encode_json(whole)) == whole


if __name__ == "__main__":
    messages, documents = ("msgpack", PROTOCOL_VERSION, MSGPACK, encode), ("json", 1, JSON, encode_json)
    for kind, version, samples, write in (messages, documents):
        for name, sample in samples.items():
            path = GOLDEN / f"{name}.v{version}.{kind}"
            if not path.exists():
                path.write_bytes(write(sample))
