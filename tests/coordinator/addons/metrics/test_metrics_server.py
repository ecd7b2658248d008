"""`/metrics` of a coordinator: slow clients, and how long an ended run waits for its scraper."""

import socket
import threading
import urllib.request

from dreamfleet.coordinator.addons.metrics import metrics_server
from dreamfleet.coordinator.addons.metrics.metrics_server import LONGEST, ScrapeTimes
from tests.support.processes import DEADLINE, free_port
from tests.support.served import snapshot


def test_a_client_that_sends_a_byte_at_a_time_delays_neither_others_nor_the_end(monkeypatch):
    monkeypatch.setattr(metrics_server, "PATIENCE", 0.5)
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
    with metrics_server.serve_metrics(str(port), snapshot, lambda: True):
        thread = threading.Thread(target=drip)
        thread.start()
        assert begun.wait(DEADLINE)
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=DEADLINE) as answer:
            assert b"dreamfleet_generation" in answer.read()
    assert dropped.wait(DEADLINE)
    over.set()
    thread.join()


def test_an_ended_run_waits_until_its_scraper_has_seen_the_end():
    scrapes = ScrapeTimes()
    assert not scrapes.is_expected(0.0, 0.0)
    scrapes.record("running", 0.0)
    assert not scrapes.is_expected(1.0, 1.0)  # a look by hand, perhaps
    scrapes.record("evaluating", 15.0)
    assert scrapes.is_expected(20.0, 49.0)
    assert not scrapes.is_expected(20.0, 50.0)
    scrapes.record("evaluating", 3600.0)
    assert scrapes.is_expected(3601.0, 3600.0 + LONGEST)
    assert not scrapes.is_expected(3601.0, 3601.0 + LONGEST), "a long interval is not waited for"
    scrapes.record("ended", 3610.0)
    assert not scrapes.is_expected(3601.0, 3610.0)
