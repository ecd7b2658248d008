"""`/metrics` of a coordinator: clients that keep its thread to themselves, and how long it waits for who scrapes."""

import socket
import threading
import urllib.request

import pytest

from dreamfleet.coordinator import scrape
from dreamfleet.coordinator.scrape import LONGEST, Scrapes
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
    with scrape.metrics_served(str(port), snapshot, lambda: True):
        thread = threading.Thread(target=drip)
        thread.start()
        assert begun.wait(10)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=20) as answer:
            assert b"dreamfleet_generation" in answer.read()
    assert dropped.wait(10)
    over.set()
    thread.join()


def test_the_end_is_kept_for_who_asks_again_and_again_until_he_has_heard():
    scrapes = Scrapes()
    assert not scrapes.awaited(0.0, 0.0)
    scrapes.tell("running", 0.0)
    assert not scrapes.awaited(1.0, 1.0)  # a look by hand, perhaps
    scrapes.tell("evaluating", 15.0)
    assert scrapes.awaited(20.0, 49.0)
    assert not scrapes.awaited(20.0, 50.0)
    scrapes.tell("ended", 30.0)
    assert not scrapes.awaited(20.0, 30.0)


def test_it_is_not_kept_for_ever():
    scrapes = Scrapes()
    scrapes.tell("running", 0.0)
    scrapes.tell("running", 3600.0)
    assert not scrapes.awaited(3601.0, 3601.0 + LONGEST)
