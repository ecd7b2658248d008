"""The codec and the golden fixtures: each message as its protocol version first wrote it, each document for ever.

`python -m tests.common.protocol.test_codec` writes a new message's fixture; it never writes one that exists.

Tests messages.py.
"""

import dataclasses
import json
from pathlib import Path

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace as changed

from dreamfleet.common.protocol.codec import CountingDecoder, decode, decode_json, encode, encode_json, encoding
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.keys import PROTOCOL_VERSION
from dreamfleet.common.protocol.messages import MAX_MESSAGE, HelloRequest, JobBatch, Message, ResultBatch
from dreamfleet.common.schema.validation import SCHEMA, MalformedError
from tests.support.mutations import mutations
from tests.support.samples import JSON, MSGPACK

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


def test_every_wire_message_has_a_fixture_and_an_encoding_that_names_its_schema():
    assert {type(sample) for sample in MSGPACK.values()} == set(Message.__subclasses__())
    assert encoding(JobBatch) == "application/msgpack;dreamfleet.job.v2"


UNREADABLE = {
    "not msgpack": (b"", b"\xc1", b"\xde\xff\xff", b"\xdd\xff\xff\xff\xff", b"\x91" * 5000, msgpack.packb({1: 2})),
    "not a message": (msgpack.packb([1]),),
    "oversize": (b"\x00" * (MAX_MESSAGE + 1),),
}


@pytest.mark.parametrize("reason", UNREADABLE)
def test_unreadable_messages_are_dropped_and_counted(reason):
    inbox = CountingDecoder()
    assert [inbox.decode(ResultBatch, payload) for payload in UNREADABLE[reason]] == [None] * len(UNREADABLE[reason])
    assert inbox.dropped == {reason: len(UNREADABLE[reason])}


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        *(("result", {"v": version}) for version in (1, None)),
        ("result", {"extra": 1}),
        ("result", {"run_uid": "short"}),
        *(("result", {"incarnation": number}) for number in (-1, True, 2**63)),
        *(("result", {"results": [{"fitness": number}]}) for number in (float("nan"), float("inf"))),
        ("result", {"results": [{"digest": b"\x01" * 31}]}),
        *(("result", {"results": [{"error": {"cause": "x", "text": "x", **odd}}]})
          for odd in ({"text": "x" * 3000}, {"cause": ""}, {"kind": "odd"})),
        ("beat", {"queued": [b"abcdefgh"] * 2000}),
        ("view", {"height": 0}),
    ],
)  # fmt: skip
def test_malformed_messages_are_dropped_counted_and_logged_once(name, changes, caplog):
    caplog.set_level("INFO")
    raw, inbox = msgpack.unpackb(encode(MSGPACK[name])), CountingDecoder()
    if "results" in changes:
        changes = {"results": [{**raw["results"][0], **changes["results"][0]}]}
    for _ in range(3):
        assert inbox.decode(type(MSGPACK[name]), msgpack.packb({**raw, **changes})) is None
    assert inbox.dropped == {"unknown version" if "v" in changes else SCHEMA: 3}
    (logged,) = caplog.records
    assert next(iter(changes)) in logged.getMessage() or "v" in changes


def test_a_default_is_not_written_whichever_object_it_is():
    result = MSGPACK["result"].results[1]
    payloads = {
        encode(changed(MSGPACK["result"], results=(changed(result, error=Failure("x", "y", kind)),)))
        for kind in ("other", "".join(("ot", "her")))
    }
    assert len(payloads) == 1


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


@given(st.binary(max_size=200) | st.sampled_from([b"[]", b"{}", b"{" * 20000, b'{"protocol_min": NaN}']))
def test_random_bytes_never_raise_past_the_inbox(payload):
    inbox = CountingDecoder()
    assert inbox.decode_json(HelloRequest, payload) is None
    assert all(inbox.decode(kind, payload) is None for kind in Message.__subclasses__())
    assert inbox.dropped.total() == 1 + len(Message.__subclasses__())


def test_damaged_messages_never_raise_and_are_all_counted_by_few_reasons():
    inbox, good, kinds = CountingDecoder(), 0, list(MSGPACK.values())
    for number, payload in enumerate(mutations(20_000, seed=1)):
        good += inbox.decode(type(kinds[number % len(kinds)]), payload) is not None
    assert inbox.dropped.total() + good == 20_000
    assert len(inbox.dropped) < 20


def test_hello_ignores_fields_of_later_versions_and_half_a_surrogate_pair_is_malformed():
    hello = JSON["hello-request"]
    assert decode_json(HelloRequest, encode_json(hello).replace(b"{", b'{"hat_size": 7, ', 1)) == hello
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
