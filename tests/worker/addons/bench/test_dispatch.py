"""The peers of `lab bench dispatch`: whatever they do, the benchmark ends. Tests simulated_workers.py."""

import time
from contextlib import contextmanager

from dreamfleet.worker.addons.bench import dispatch


@contextmanager
def hanging():
    yield lambda _work, _count: time.sleep(3600)


@contextmanager
def failing():
    raise RuntimeError("not today")
    yield


@contextmanager
def prompt():
    yield lambda work, count: [work(index) for index in range(min(count, 2))]


def test_a_peer_is_measured_in_a_process_of_its_own():
    assert dispatch.run_peer(prompt).keys() == {"efficiency_50ms", "null_jobs_per_second"}


def test_a_peer_that_hangs_or_fails_has_no_figures(monkeypatch):
    assert dispatch.run_peer(failing) is None
    monkeypatch.setattr(dispatch, "PEER_SECONDS", 1.0)
    assert dispatch.run_peer(hanging) is None
