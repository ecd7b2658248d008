"""Tests network.py and query.py."""

import re
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest
import zenoh

from dreamfleet.common.errors import ConnectionFailedError, UsageError
from dreamfleet.common.transport.network import wait_for_listener, with_interface_index
from dreamfleet.common.transport.query import query_all, query_every_responder
from dreamfleet.common.transport.session import Network, check_endpoint, open_session
from tests.support.processes import DEADLINE, free_port, until
from tests.support.wall_clock import WallClock

EXCHANGE = """if True:
    import queue, sys
    from dreamfleet.common.transport.session import Network, open_session
    came, where = queue.SimpleQueue(), (sys.argv[1],)
    def answer(query):
        came.put("query")
        query.reply(query.key_expr, b"")
    with open_session(Network(listen=where)) as router, open_session(Network(connect=where)) as client:
        subscriber = router.declare_subscriber("a/*", lambda _: came.put("put"))
        queryable = router.declare_queryable("b", answer)
        token = client.liveliness().declare_token("t")
        client.put("a/1", b"")
        print(came.get(timeout=30), end=" ")
        replies = client.get("b", timeout=30)
        print(came.get(timeout=30), "reply" if next(replies).ok else "", end=" ", flush=True)
        router.put("c", b"")
"""


def test_bad_endpoints_are_refused():
    for endpoint in ("tcp/127.0.0.1:7447", "tls/host.example:1", "tcp/[::1]:7447", "tcp/[fe80::1%lo]:7447"):
        assert check_endpoint(endpoint) == endpoint
    for endpoint in ("", "127.0.0.1:7447", "tcp/host", "tcp/host:99999", "tcp/ host:1", "ftp/h:21", "ws/h:1"):
        with pytest.raises(UsageError, match=re.escape(repr(endpoint))):
            Network(listen=(endpoint,))
    with pytest.raises(UsageError, match=r"quic/host\.example:7447.*--join"):
        check_endpoint("quic/host.example:7447")


def test_a_link_local_address_has_its_interfaces_index_for_zenoh():
    index, name = socket.if_nameindex()[0]
    assert with_interface_index(f"tcp/[fe80::1%{name}]:7447") == f"tcp/[fe80::1%{index}]:7447"
    for each in ("tcp/[fe80::1%7]:7447", "tcp/[::1]:7447", "tcp/host.example:7447"):
        assert with_interface_index(each) == each
    with pytest.raises(ConnectionFailedError) as refused:  # an interface of this host, and nobody's address there
        open_session(Network(listen=(f"tcp/[fe80::1%{name}]:{free_port()}",)))
    assert ".cargo" not in str(refused.value)
    for network in (Network(listen=("tcp/[fe80::1%nowhere0]:7447",)), Network(connect=("tcp/[fe80::1%nowhere0]:1",))):
        with pytest.raises(UsageError, match=name):
            open_session(network, timeout=0.2)


def test_a_port_in_use_and_an_address_without_a_listener_are_errors():
    network = Network(listen=(f"tcp/127.0.0.1:{free_port()}",))
    with open_session(network), pytest.raises(ConnectionFailedError, match="--listen"):
        open_session(network)
    with pytest.raises(ConnectionFailedError, match="--connect"):
        open_session(Network(connect=(f"tcp/127.0.0.1:{free_port()}",)), timeout=0.2)


def served(endpoint):
    """A router at this endpoint, which replies with its address."""
    session = open_session(Network(listen=(endpoint,)))
    session.declare_queryable("who", lambda query: query.reply("who", endpoint))
    return session


def await_answer(session, endpoint):
    """Wait until the router of this endpoint replies."""

    def answers():
        return [reply.ok.payload.to_string() for reply in session.get("who", timeout=1) if reply.ok]

    until(lambda: answers() == [endpoint], "its answer")


def test_the_reachable_address_is_used_first_and_again():
    first, second = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    router = served(second)
    with open_session(Network(connect=(first, second))) as session:
        await_answer(session, second)
        for here in (second, first, second):  # it comes back where it was, and elsewhere
            router.close()
            router = served(here)
            await_answer(session, here)
    router.close()


@pytest.mark.slow
def test_an_address_that_drops_packets_does_not_block_the_others():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        socket.create_server(("127.0.0.1", 0)) as mute,
        served(endpoint),
        open_session(Network(connect=(f"tcp/127.0.0.1:{mute.getsockname()[1]}", endpoint))) as session,
    ):
        await_answer(session, endpoint)


def test_a_listener_that_comes_later_is_noticed():
    asked = Event()
    with socket.socket() as listener, ThreadPoolExecutor() as pool:
        listener.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{listener.getsockname()[1]}"
        found = pool.submit(wait_for_listener, (endpoint,), DEADLINE, asked.set)  # `set` returns None: go on
        assert asked.wait(DEADLINE)  # it looked in vain
        listener.listen()
        assert found.result(DEADLINE)
        assert wait_for_listener((endpoint,), 0.0, lambda: True)


def test_the_wait_ends_with_its_time_when_it_is_stopped_and_at_once_for_another_host_or_protocol():
    assert not wait_for_listener(("tcp/127.0.0.1:1",), 0.0, lambda: False)
    assert not wait_for_listener(("tcp/127.0.0.1:1",), DEADLINE, lambda: True)
    for others in (("tcp/192.0.2.1:1",), ("tcp/127.0.0.1:1", "tcp/192.0.2.1:1"), ("udp/127.0.0.1:1",)):
        assert wait_for_listener(others, DEADLINE, lambda: False)


@pytest.mark.skipif(not WallClock.possible(), reason="sets a clock by a library that it compiles")
@pytest.mark.parametrize("years", [-60, 85])
def test_sessions_work_whatever_the_wall_clock_says(tmp_path, years):
    (clock := WallClock(tmp_path)).set(years * 31_557_600)
    words = (*clock.inside, sys.executable, "-c", EXCHANGE, f"tcp/127.0.0.1:{free_port()}")
    assert subprocess.run(words, capture_output=True, check=True, timeout=DEADLINE).stdout == b"put query reply "


HELD = []


@pytest.fixture(scope="module")
def session():
    """A client of a router that replies to `a/*` with the query's key and payload, and never to `b`."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"

    def answer(query):
        with query:
            if str(query.key_expr) == "a/wrong":
                query.reply_err(b"no")
                return
            said = b"" if query.payload is None else query.payload.to_bytes()
            query.reply(query.key_expr, str(query.key_expr).encode() + b" " + said)

    with open_session(Network(listen=(endpoint,))) as router, open_session(Network(connect=(endpoint,))) as client:
        declared = [
            router.declare_queryable("a/*", zenoh.handlers.Callback(answer, indirect=False)),
            router.declare_queryable("b", zenoh.handlers.Callback(HELD.append, indirect=False)),
        ]
        yield client
        for each in HELD:
            each.drop()
        del declared


def test_every_reply_to_every_query_is_returned_and_errors_and_unserved_keys_are_none(session):
    assert sorted(query_all(session, ["a/1", "a/2"], 10.0)) == [b"a/1 ", b"a/2 "]
    assert [found for _, found in query_every_responder(session, ["a/3"], 10.0, b"{}")] == [b"a/3 {}"]
    assert query_all(session, ["a/wrong", "nobody"], 10.0) == query_all(session, [], 10.0) == []


def test_the_timeout_ends_a_query_and_keeps_earlier_replies(session):
    assert query_all(session, ["a/1", "b"], 0.3) == [b"a/1 "]


def test_stopping_does_not_wait_for_the_timeout(session):
    looks = iter([False, False, True])
    assert list(query_every_responder(session, ["b"], 3600.0, stopped=lambda: next(looks))) == []
