"""Benchmarks that need a fleet: a real coordinator, simulated workers, the HTTP bridge. Tests batches.py."""

import pytest

from dreamfleet.worker.addons.bench import batches, dispatch
from dreamfleet.worker.addons.bench.sleep_tasks import NULL_TASK


@pytest.mark.slow
def test_each_way_evaluates_each_population_within_the_limits_of_a_request(monkeypatch):
    def call_once(cases):
        for call in cases.values():
            call()
        return dict.fromkeys(cases, 1.0)

    monkeypatch.setattr(batches, "time_alternately", call_once)
    rates = batches.bench_batches()["evaluations_per_second"]
    assert rates == {
        f"population_{size}": dict.fromkeys(("zenoh", "http", "http_base64"), size) for size in batches.POPULATIONS
    }


@pytest.mark.slow
def test_simulated_workers_finish_a_run():
    with dispatch.start_run(NULL_TASK, 64, 64) as run, run.crowd(2, 32):
        figures = run.finish_null_jobs()
    assert min(figures.values()) > 0
