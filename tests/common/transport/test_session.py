import socket
import time

import pytest

from dreamfleet.common.errors import ConnectionFailedError, UsageError
from dreamfleet.common.transport.session import Network, check_endpoint, open_session
from tests.support.processes import DEADLINE, free_port


@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:7447", "tls/host.example:1", "tcp/[::1]:7447"])
def test_good_endpoints(endpoint):
    assert check_endpoint(endpoint) == endpoint


@pytest.mark.parametrize("endpoint", ["", "127.0.0.1:7447", "tcp/host", "tcp/host:99999", "tcp/ host:1", "ftp/host:21"])
def test_bad_endpoints_are_refused(endpoint):
    with pytest.raises(UsageError, match="write it as tcp/HOST:PORT"):
        Network(listen=(endpoint,))


def test_a_port_in_use_says_so():
    network = Network(listen=(f"tcp/127.0.0.1:{free_port()}",))
    with open_session(network), pytest.raises(ConnectionFailedError, match=r"is in use: .*--listen"):
        open_session(network)


def test_nobody_there_says_so():
    with pytest.raises(ConnectionFailedError, match="nobody answers at"):
        open_session(Network(connect=(f"tcp/127.0.0.1:{free_port()}",)), timeout=0.2)


def served(endpoint):
    """A router that answers there, by its own address."""
    session = open_session(Network(listen=(endpoint,)))
    session.declare_queryable("who", lambda query: query.reply("who", endpoint))
    return session


def await_answer(session, endpoint):
    """Until the router of this address is the one that is asked."""
    deadline = time.monotonic() + DEADLINE
    while [reply.ok.payload.to_string() for reply in session.get("who", timeout=1) if reply.ok] != [endpoint]:
        assert time.monotonic() < deadline, "nobody answers there"
        time.sleep(0.1)


def test_whichever_of_its_addresses_answers_is_found_first_and_again():
    first, second = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    router = served(second)
    with open_session(Network(connect=(first, second))) as session:
        await_answer(session, second)
        for here in (second, first, second):  # it comes back where it was, and elsewhere
            router.close()
            router = served(here)
            await_answer(session, here)
    router.close()


def test_an_address_that_swallows_everything_keeps_nobody_from_the_others():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with (
        socket.create_server(("127.0.0.1", 0)) as mute,
        served(endpoint),
        open_session(Network(connect=(f"tcp/127.0.0.1:{mute.getsockname()[1]}", endpoint))) as session,
    ):
        await_answer(session, endpoint)
