"""What unknown senders put on the wire changes nothing and is counted; workers of other protocols get a remedy.

Tests coordinator/dispatch/fleet.py, coordinator/dispatch/refusals.py, coordinator/run/worker_protocol.py,
coordinator/service/control.py, coordinator/service/inbound_queue.py, coordinator/service/queryables.py and
worker/service/admission.py.
"""

import json
import os
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

import pytest
import zenoh

from dreamfleet.common.client.client import Client
from dreamfleet.common.client.status import PARTS
from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import decode_json, encode, encode_json
from dreamfleet.common.protocol.messages import MAX_MESSAGE, ControlReply, HelloReply
from dreamfleet.common.transport.session import Network, open_session
from tests.support import tasks
from tests.support.mutations import mutations
from tests.support.processes import DEADLINE, until
from tests.support.samples import JSON, MSGPACK

BLOCK = zenoh.CongestionControl.BLOCK  # else a busy host loses some
KEYS = {"result": keys.result, "beat": keys.heartbeat, "upload": keys.upload}


@pytest.fixture
def busy(processes, small):
    """A coordinator that has work, without end."""
    coordinator = processes.coordinator(*small)
    processes.worker("--task", tasks.SLOW_TOY)
    coordinator.wait_for_event("generation", number=0)
    return coordinator


@pytest.mark.slow
def test_a_coordinator_drops_and_counts_what_is_malformed_or_foreign(processes, small):
    coordinator = processes.coordinator(*small, "--generations", 2)
    with open_session(Network(connect=(processes.endpoint,))) as session:
        for number, kind in enumerate(KEYS):
            for payload in (b"", b"\xc1\xff", bytes(MAX_MESSAGE + 1), encode(MSGPACK[kind]), encode(MSGPACK["view"])):
                session.put(key_of_a_stranger(number), payload, congestion_control=BLOCK)
        replies = list(session.get(keys.hello("test"), payload=b"let me in", timeout=DEADLINE))
        assert b'"accepted": false' in replies[0].ok.payload.to_bytes()
        assert not list(session.get(keys.bundle("test", "ab" * 32), timeout=1))
    until(lambda: count_dropped(processes) >= 16)
    counted = {"not msgpack": 6, "oversize": 3, "foreign run": 3, "schema": 3, "not JSON": 1}
    assert processes.status()["dropped"] == counted
    processes.worker("--task", tasks.SLOW_TOY)
    assert coordinator.finish()[0] == 0


def key_of_a_stranger(number):
    return [*KEYS.values()][number % 3]("test", "stranger/0badc0de")


def count_dropped(processes):
    return sum(processes.status()["dropped"].values())


def resident(process):
    return int(Path(f"/proc/{process.popen.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("counts", [(2000,), pytest.param((10_000, 50_000, 50_000), marks=pytest.mark.long)])
def test_floods_of_damaged_messages_are_counted_to_the_last_and_leave_no_other_trace(processes, busy, counts):
    """The first flood makes the buffers, about 20 MB. The allocator may grow once more; a leak grows in each flood."""
    dropped, held = [], []
    with open_session(Network(connect=(processes.endpoint,))) as session:
        for seed, count in enumerate(counts):
            for number, payload in enumerate(mutations(count, seed)):
                session.put(key_of_a_stranger(number), payload, congestion_control=BLOCK)
            sent = sum(counts[: seed + 1])
            until(lambda sent=sent: count_dropped(processes) >= sent)
            dropped.append(count_dropped(processes))
            held.append(resident(busy))
    busy.wait_for_event("generation", times=2)
    assert dropped[0] == counts[0]
    assert min((later - before for before, later in pairwise(held)), default=0) < 10e6


SPOKEN = {"protocol_min": keys.PROTOCOL_VERSION, "protocol_max": keys.PROTOCOL_VERSION}
HELLO = replace(JSON["hello-request"], tasks=(tasks.SLOW_TOY,), slots=1, **SPOKEN)


def say(session, key, payload=None):
    """The one answer to a query."""
    (reply,) = list(session.get(key, payload=payload, timeout=DEADLINE))
    return reply.ok.payload.to_bytes()


def hello(session, **changes):
    """What a coordinator answers to a hello, whose text may be what no worker of ours would say."""
    document = {**asdict(HELLO), **changes}
    return decode_json(HelloReply, say(session, keys.hello("test"), json.dumps(document).encode()))


@pytest.mark.slow
def test_no_hello_and_no_control_verb_is_too_long_to_be_answered(processes, small):
    coordinator = processes.coordinator(*small, "--episodes", 2, "--generations", 2, "--strict")
    with open_session(Network(connect=(processes.endpoint,))) as session:
        names = [f"task-{number}-{'x' * 100}" for number in range(80)]
        assert not (reply := hello(session, tasks=names)).accepted
        assert "task-0-" in reply.why
        assert not (reply := hello(session, fingerprint="half a pair: \ud800")).accepted
        processes.worker("--task", tasks.SLOW_TOY)
        coordinator.wait_for_event("generation", number=0)
        for strange in ("y" * 2000, "\x1b" * 2000):
            assert not (reply := hello(session, fingerprint=strange, host_class="0" * 16)).accepted
        reply = decode_json(ControlReply, say(session, keys.control("test", "z" * 3000)))
        assert not reply.accepted
    assert coordinator.finish()[0] == 0


STRANGE = ["9" * 5000, "9" * 18, "-1", "-" + "9" * 5000, "1.5", "", "1e3", "²", "%00", "[bold]", "NaN"]


def test_every_query_is_answered_whatever_it_asks_for(processes, random_bundle):
    processes.coordinator("--bundle", random_bundle.path, "--task", tasks.TOY)
    with open_session(Network(connect=(processes.endpoint,))) as session:
        for text in STRANGE:
            asked = f"?offset={text};limit={text};length={text};generation={text}"
            for part in PARTS:
                (reply,) = session.get(keys.status("test", part) + asked, timeout=DEADLINE)
                assert b'"run": "test"' in reply.ok.payload.to_bytes(), (part, text[:20])
            (_answer,) = session.get(keys.bundle("test", random_bundle.sha256) + asked, timeout=DEADLINE)
    assert processes.status()["state"] == "waiting for workers"


@pytest.mark.slow
def test_large_messages_fill_no_memory_and_the_run_goes_on(processes, busy):
    before, most = resident(busy), 0
    with open_session(Network(connect=(processes.endpoint,))) as session:
        for number in range(40):
            session.put(key_of_a_stranger(number), bytes(40_000_000), congestion_control=BLOCK)
            most = max(most, resident(busy))
        busy.wait_for_event("generation", times=2)
    assert most - before < 100e6


@pytest.mark.slow
def test_a_flood_of_hellos_leaves_few_unconfirmed_workers_and_the_run_goes_on(processes, busy):
    before = resident(busy)
    with open_session(Network(connect=(processes.endpoint,))) as session:
        for number in range(6_000):
            request = replace(HELLO, worker=f"stranger/{number:08x}", fingerprint="x" * 2000, slots=2**60)
            session.get(keys.hello("test"), lambda _: None, payload=encode_json(request), timeout=2)
        busy.wait_for_event("generation", times=2)
        status = processes.status()
    assert 1 < status["workers"]["known"] < 400
    assert status["dropped"]["too many in a second"] > 1000
    assert resident(busy) - before < 60e6


OTHERS = (1, 1), (3, 4), (2**60, 2**62)
OURS = (1, 2), (2, 3), (2, 2)


def test_a_worker_joins_if_it_speaks_this_protocol_and_else_gets_a_remedy(processes):
    processes.coordinator("--task", tasks.TOY, "--population", 4, "--episodes", 1, "--generations", 3)
    old = {"worker": "old/0a1b2c3d", "tasks": (tasks.TOY,), "fingerprint": fingerprint()}
    with open_session(Network(connect=(processes.endpoint,))) as session, Client((processes.endpoint,)) as client:
        for spoken in OTHERS:
            reply = hello(session, **old, protocol_min=spoken[0], protocol_max=spoken[1])
            assert not reply.accepted
            assert all(str(each) in reply.why for each in (*spoken, keys.PROTOCOL_VERSION))
            assert reply.remedy
            until(lambda why=reply.why: client.status().refused == {"old": why})
        for first, last in OURS:
            assert hello(session, **old, protocol_min=first, protocol_max=last).accepted
        until(lambda: not client.status().refused)
