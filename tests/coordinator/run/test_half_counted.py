"""A fault of ours in the middle of one result: it costs no other result, and is never half of a run's state."""

import pytest

from dreamfleet.common.errors import InternalError
from dreamfleet.common.protocol.messages import Result, ResultBatch
from tests.coordinator.run.test_run import SETTINGS, B, Bench


@pytest.fixture
def bench(tmp_path, random_bundle):
    made = Bench(tmp_path / "run", random_bundle.path, SETTINGS)
    yield made
    made.journal.close()


def given_jobs(bench):
    """Both to one worker."""
    bench.run.fleet.handle_departure(B, bench.now)
    bench.now += 1
    bench.run.tick(bench.now)
    return [(send.identity, work.job) for send in bench.run.fleet.dispatch(bench.now) for work in send.content.work]


def scored(job):
    return Result(job.digest, 1.0, 10, 0.1, None, None)


def say(bench, worker, *results):
    batch = ResultBatch(run_uid=bench.run.uid, incarnation=1, fingerprint="f", results=results)
    bench.worker_protocol.handle_results(worker, batch, bench.now)


def test_a_result_that_raises_before_it_counts_costs_no_other_one(bench, monkeypatch):
    (worker, first), (_, second) = given_jobs(bench)
    judge = bench.run.fleet.handle_result

    def stumble(identity, result, now):
        if result.digest == first.digest:
            raise ZeroDivisionError
        return judge(identity, result, now)

    monkeypatch.setattr(bench.run.fleet, "handle_result", stumble)
    with pytest.raises(ZeroDivisionError):
        say(bench, worker, scored(first), scored(second))
    assert first.digest in bench.run.fleet.jobs, "its worker says it again"
    assert second.digest not in bench.run.fleet.jobs
    monkeypatch.undo()
    say(bench, worker, scored(first), scored(second))
    assert bench.run.generation.complete


def test_a_result_that_raises_while_it_is_counted_ends_the_life_and_the_next_one_loses_nothing(bench, monkeypatch):
    (worker, first), (_, second) = given_jobs(bench)

    def stumble(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(bench.run.generation, "record", stumble)
    with pytest.raises(InternalError, match=r"ZeroDivisionError.*--resume"):
        say(bench, worker, scored(first))
    bench.restart()
    say(bench, worker, scored(first), scored(second))
    assert bench.run.generation.complete
