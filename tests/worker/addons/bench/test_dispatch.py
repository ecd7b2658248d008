"""The peers of `lab bench dispatch`: whatever they do, the benchmark ends.
Tests simulated_workers.py and sleep_tasks.py."""

import time
from contextlib import contextmanager

import pytest

from dreamfleet.worker.addons.bench import dispatch
from dreamfleet.worker.addons.bench.sleep_tasks import HALF_SECOND_TASK, NULL_TASK, SLEEP_TASK
from dreamfleet.worker.tasks.registry import find_task


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


@pytest.mark.parametrize("name", [SLEEP_TASK, NULL_TASK, HALF_SECOND_TASK])
def test_a_worker_finds_its_tasks_by_name(name):
    assert find_task(name).name == name
