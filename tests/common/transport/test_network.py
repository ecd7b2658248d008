import socket
from concurrent.futures import ThreadPoolExecutor
from threading import Event

from dreamfleet.common.transport.network import wait_for_listener
from tests.support.processes import DEADLINE


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


def test_the_wait_ends_with_its_time_and_when_it_is_stopped():
    assert not wait_for_listener(("tcp/127.0.0.1:1",), 0.0, lambda: False)
    assert not wait_for_listener(("tcp/127.0.0.1:1",), DEADLINE, lambda: True)


def test_nothing_is_waited_for_on_another_host_or_by_another_protocol():
    for others in (("tcp/192.0.2.1:1",), ("tcp/127.0.0.1:1", "tcp/192.0.2.1:1"), ("udp/127.0.0.1:1",)):
        assert wait_for_listener(others, DEADLINE, lambda: False)
