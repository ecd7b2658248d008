"""`/metrics` of a coordinator, and clients that keep its one thread to themselves."""

import socket
import threading
import urllib.request

import pytest

from dreamfleet.coordinator import scrape
from tests.support.processes import free_port
from tests.support.served import snapshot


@pytest.mark.timeout(60)
def test_who_asks_a_byte_at_a_time_holds_up_neither_others_nor_the_end(monkeypatch):
    monkeypatch.setattr(scrape, "PATIENCE", 0.5)
    port, over = free_port(), threading.Event()

    def drip():
        with socket.create_connection(("127.0.0.1", port)) as slow:
            slow.sendall(b"GET /metrics HTTP/1.1\r\n")
            begun.set()
            try:
                while not over.wait(0.1):
                    slow.sendall(b"X")
            except OSError:
                dropped.set()

    begun, dropped = threading.Event(), threading.Event()
    with scrape.metrics_served(str(port), snapshot):
        thread = threading.Thread(target=drip)
        thread.start()
        assert begun.wait(10)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as answer:
            assert b"dreamfleet_generation" in answer.read()
    assert dropped.wait(10)
    over.set()
    thread.join()
