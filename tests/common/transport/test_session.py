import re
import socket
import time

import pytest

from dreamfleet.common.errors import ConnectionFailedError, DreamfleetError, UsageError
from dreamfleet.common.transport.network import with_interface_index
from dreamfleet.common.transport.session import Network, check_clock, check_endpoint, open_session
from tests.support.processes import DEADLINE, free_port


@pytest.mark.parametrize(
    "endpoint", ["tcp/127.0.0.1:7447", "tls/host.example:1", "tcp/[::1]:7447", "tcp/[fe80::1%lo]:7447"]
)
def test_good_endpoints(endpoint):
    assert check_endpoint(endpoint) == endpoint


@pytest.mark.parametrize("endpoint", ["", "127.0.0.1:7447", "tcp/host", "tcp/host:99999", "tcp/ host:1", "ftp/host:21"])
def test_bad_endpoints_are_refused(endpoint):
    with pytest.raises(UsageError, match=re.escape(repr(endpoint))):
        Network(listen=(endpoint,))


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


def test_quic_is_refused_with_the_forms_that_work():
    with pytest.raises(UsageError) as refused:
        check_endpoint("quic/host.example:7447")
    assert "quic/host.example:7447" in str(refused.value)
    assert "--join" in str(refused.value)


def test_a_port_in_use_is_an_error():
    network = Network(listen=(f"tcp/127.0.0.1:{free_port()}",))
    with open_session(network), pytest.raises(ConnectionFailedError, match="--listen"):
        open_session(network)


def test_no_listener_is_an_error():
    with pytest.raises(ConnectionFailedError, match="--connect"):
        open_session(Network(connect=(f"tcp/127.0.0.1:{free_port()}",)), timeout=0.2)


def served(endpoint):
    """A router at this endpoint, which replies with its address."""
    session = open_session(Network(listen=(endpoint,)))
    session.declare_queryable("who", lambda query: query.reply("who", endpoint))
    return session


def await_answer(session, endpoint):
    """Wait until the router of this endpoint replies."""
    deadline = time.monotonic() + DEADLINE
    while [reply.ok.payload.to_string() for reply in session.get("who", timeout=1) if reply.ok] != [endpoint]:
        assert time.monotonic() < deadline, "nobody answers there"
        time.sleep(0.1)


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


@pytest.mark.parametrize("seconds", [-1.0, 2.0**32])
def test_a_clock_that_zenoh_cannot_write_is_an_error_that_says_so(seconds):
    with pytest.raises(DreamfleetError, match=f"{seconds:.0f}"):
        check_clock(seconds)
    check_clock(2.0**32 - 1)
