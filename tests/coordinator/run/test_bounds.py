"""Extreme numbers fail their job, and never end a run.
Tests common/protocol/result_bounds.py."""

import json
import sqlite3
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dreamfleet.common.protocol.codec import encode_json
from dreamfleet.common.protocol.messages import MAX_SLOTS, HelloRequest, Result
from dreamfleet.common.protocol.result_bounds import (
    LARGEST_FITNESS,
    MAX_COUNT,
    MAX_SECONDS,
    clamp_count,
    max_steps,
    rejection_reason,
    to_finite,
)
from dreamfleet.common.protocol.stop_kind import PauseKind, StopKind
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.evolution import Evolution
from dreamfleet.coordinator.service.snapshot import take_snapshot
from dreamfleet.coordinator.service.status import encode_part
from tests.support.dispatched import result
from tests.support.failures import failure
from tests.support.run_bench import SETTINGS, A, Bench
from tests.support.samples import SPEC

PLAIN = replace(SETTINGS, collect_every=0, population=4, episodes=2, evaluate_every=1, evaluation_episodes=2)
FINE = 1.0, 10, 0.1  # fitness, steps, seconds
EXTREME = {
    "an overflowing mean": (1.7e308, 10, 0.1), "an infinite deviation": (1e170, 10, 0.1),
    "a deviation from below": (-1e170, 10, 0.1), "steps": (1.0, MAX_COUNT, 0.1),
}  # fmt: skip


@pytest.fixture
def bench(make_bench):
    return make_bench(Bench, PLAIN, generations=2)


def deliver_all(bench, numbers=FINE, kinds=("score", "evaluate", "collect")):
    fetched = bench.fetch()
    for name, job in fetched:
        bench.deliver(name, Result(job.digest, *(numbers if job.kind in kinds else FINE), None, None))
    return fetched


def answers_of(bench):
    """Every answer of the run's status keys, decoded."""
    snapshot = take_snapshot(bench.run, "night", {}, 1.0, bench.now)
    return {
        part: json.loads(encode_part(snapshot, part, {}.get))
        for part in ("", "history", "workers", "candidates", "generation", "best")
    }


@pytest.mark.parametrize("numbers", EXTREME.values(), ids=EXTREME)
@pytest.mark.parametrize("kind", ["score", "evaluate"])
def test_an_extreme_result_fails_its_job_with_the_reason_and_the_run_can_continue(bench, numbers, kind):
    while bench.run.state.paused is None and deliver_all(bench, numbers, (kind,)):
        answers_of(bench)
    assert bench.run.state.paused.pauses[0].kind is PauseKind.FAILED_JOB
    assert bench.run.fleet.jobs.failures
    assert answers_of(bench)[""]["state"] == "paused"
    bench.restart()
    assert bench.run.state.paused is None
    while bench.run.state.ended is None:
        assert deliver_all(bench)
        answers_of(bench)
    assert bench.run.state.ended.kind is StopKind.GENERATIONS


def test_generations_and_evaluations_without_finite_numbers_can_be_encoded(bench):
    while len(bench.run.history) < 1:
        deliver_all(bench)
    bench.run.commit()
    with closing(sqlite3.connect(bench.path / "journal.sqlite")) as connection, connection:
        for table in ("generation", "evaluation"):
            connection.execute(f"UPDATE {table} SET checksum = NULL")
        connection.execute("UPDATE generation SET mean = 9e999, std = NULL, best = 9e999, worst = -9e999, steps = ?",
                           (MAX_COUNT,))  # fmt: skip
        connection.execute("UPDATE evaluation SET mean = 9e999, std = NULL WHERE mean IS NOT NULL")
    bench.restart()
    bench.now += 1
    deliver_all(bench)
    answers_of(bench)
    while bench.run.state.ended is None:
        assert deliver_all(bench)
    bench.run.leave()
    answers_of(bench)


def test_huge_counts_of_slots_and_steps_can_be_encoded(bench):
    bench.run.admission.admit(HelloRequest(2, 2, "0", "c/00000003", (SPEC.task,), "f", MAX_COUNT), bench.now)
    bench.run.fleet.counts["discarded_steps"] = 3 * MAX_COUNT
    answers = answers_of(bench)
    assert [row["slots"] for row in answers["workers"]["workers"]] == [4, 4, MAX_SLOTS]
    assert answers[""]["waste"]["discarded_steps"] == MAX_COUNT


def test_an_error_with_too_many_steps_is_an_error(bench):
    for _ in range(3):
        (name, job), *_ = bench.fetch()
        bench.deliver(name, result(job.digest, error=failure("boom"), steps=MAX_COUNT))
        assert bench.run.fleet.jobs[job.digest].attempts[-1].error == failure("boom")
        answers_of(bench)
    assert bench.run.fleet.counts["errors"] == 3


@given(st.floats(), st.integers(), st.floats())
def test_accepted_numbers_can_be_summed_over_the_largest_run(fitness, steps, seconds):
    if rejection_reason(fitness, steps, seconds, 1000) is None:
        assert abs(fitness) <= LARGEST_FITNESS
        assert 0 <= steps <= max_steps(1000)
        assert 0 <= seconds <= MAX_SECONDS
        assert np.isfinite(np.float64(fitness) ** 2 * 1e9)


@given(st.integers(), st.floats())
def test_clamped_numbers_can_be_encoded(steps, value):
    assert 0 <= clamp_count(steps) <= MAX_COUNT
    assert np.isfinite(to_finite(value))
    assert encode_json(replace(HelloRequest(2, 2, "0", A, (), "f", 1), slots=clamp_count(steps)))


@pytest.mark.parametrize("optimiser", ["cma", "cmaes-sep", "cmaes-lra"])
def test_an_optimiser_accepts_all_fitness_within_the_bounds(optimiser):
    evolution = Evolution(optimiser, Search(np.zeros(6), 8, 0.1, 1))
    for scale in (LARGEST_FITNESS, 1.0, 1e-300):
        for _ in range(20):
            asked = evolution.ask()
            evolution.tell(np.clip(-(asked**2).sum(axis=1) * scale, -LARGEST_FITNESS, LARGEST_FITNESS))
            evolution.restore(evolution.state().packed())
            assert np.isfinite(asked).all()
