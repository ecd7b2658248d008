"""Who keeps a connection to a web server where more are open than it allows: real sockets, a small application."""

import asyncio
import resource
import socket
import threading
from contextlib import ExitStack, suppress

import pytest
import uvicorn
from uvicorn.server import ServerState

from dreamfleet.coordinator.addons.web import server
from dreamfleet.coordinator.addons.web.address import WebAddress
from tests.support.processes import DEADLINE, until

MOST = 20
HALF, WHOLE, ENDLESS = b"GET / HT", b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", b"GET /endless HTTP/1.1\r\nHost: x\r\n\r\n"


async def answer(scope, receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
    if scope["path"] == "/endless":
        while (await receive())["type"] != "http.disconnect":
            pass
    await send({"type": "http.response.body", "body": b"ok"})


class Server:
    """A server in a thread, and its clients."""

    def __init__(self, stack):
        self.stack, self.state, self.loop = stack, ServerState(), asyncio.new_event_loop()
        self.listening = stack.enter_context(server.open_socket(WebAddress("127.0.0.1", 0)))
        stack.callback(self.loop.close)
        config = uvicorn.Config(answer, log_config=None, lifespan="off", ws="none")
        self.loop.run_until_complete(
            self.loop.create_server(
                lambda: server.HttpConnection(config, self.state, {}, self.loop), sock=self.listening
            )
        )
        self.thread = threading.Thread(target=self.loop.run_forever)
        self.thread.start()
        stack.callback(self.end)

    def client(self, request, address="127.0.0.1"):
        """A connection from that address that has sent `request` and that the server has."""
        known = len(self.state.connections)
        client = self.stack.enter_context(
            socket.create_connection(self.listening.getsockname(), DEADLINE, (address, 0))
        )
        client.sendall(request)
        until(lambda: len(self.state.connections) in (known + 1, MOST), "the connection")
        assert request is not ENDLESS or client.recv(4096), "the head of its response"
        return client

    def end(self):
        async def close():
            for each in self.state.connections:
                each.transport.abort()
            while self.state.connections or self.state.tasks:
                await asyncio.sleep(0.01)
            self.loop.stop()

        asyncio.run_coroutine_threadsafe(close(), self.loop)
        self.thread.join()


@pytest.fixture
def serving(monkeypatch):
    monkeypatch.setattr(server, "MOST_CONNECTIONS", MOST)
    monkeypatch.setattr(server, "IDLE_TIMEOUT", 2 * DEADLINE)
    with ExitStack() as stack:
        yield Server(stack)


def is_open(client):
    client.settimeout(0.0)
    try:
        return client.recv(4096) != b""
    except BlockingIOError:
        return True
    except ConnectionResetError:
        return False


def is_answered(client):
    client.settimeout(DEADLINE)
    with suppress(ConnectionResetError):
        return client.recv(4096).startswith(b"HTTP/1.1 200 OK")
    return False


def test_half_requests_of_one_address_give_way_to_all_others(serving):
    other = serving.client(HALF, "127.0.0.2")
    half = [serving.client(HALF) for _ in range(3 * MOST)]
    until(lambda: sum(map(is_open, half)) == MOST - 1, "all but so many are closed")
    assert all(map(is_open, half[-(MOST - 1) :])), "the oldest give way"
    for _ in range(3):
        assert is_answered(serving.client(WHOLE, "127.0.0.3"))
    assert is_open(other), "its address holds one"


def test_endless_responses_give_way_only_where_nothing_is_idle(serving):
    other = serving.client(ENDLESS, "127.0.0.2")
    endless = [serving.client(ENDLESS) for _ in range(MOST - 2)]
    idle = serving.client(HALF, "127.0.0.2")
    assert is_answered(serving.client(WHOLE, "127.0.0.3"))
    until(lambda: not is_open(idle), "the idle one is closed")
    assert sum(map(is_open, endless)) == MOST - 2
    more = [serving.client(ENDLESS, "127.0.0.4") for _ in range(2)]
    until(lambda: not is_open(endless[0]), "the oldest of the address with most is closed")
    assert all(map(is_open, (*endless[1:], other, *more)))


def test_a_server_leaves_room_below_the_usual_limit_of_open_files():
    assert server.MOST_CONNECTIONS + 2 * server.BACKLOG < 1024 - 100
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[1] >= 1024


def test_no_connection_waits_for_more_to_send(serving):
    serving.client(ENDLESS)
    [connection] = serving.state.connections
    assert connection.transport.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
