"""Hellos, results and foreign messages; an exception while one result is handled leaves none half counted."""

import pytest

from dreamfleet.common.errors import InternalError
from dreamfleet.common.protocol.messages import ResultBatch
from dreamfleet.common.schema.validation import MAX_TEXT
from dreamfleet.coordinator.dispatch.refusals import Refusal
from tests.support.dispatched import result
from tests.support.run_bench import B, Bench


@pytest.fixture
def bench(make_bench):
    return make_bench(Bench)


def given_jobs(bench):
    """Jobs, all given to one worker."""
    bench.run.fleet.handle_departure(B, bench.now)
    bench.wait()
    return bench.fetch()


def test_an_exception_before_a_result_counts_loses_no_other_result(bench, monkeypatch):
    (worker, first), (_, second) = given_jobs(bench)
    judge = bench.run.fleet.handle_result

    def stumble(identity, given, now, host_class):
        if given.digest == first.digest:
            raise ZeroDivisionError
        return judge(identity, given, now, host_class)

    monkeypatch.setattr(bench.run.fleet, "handle_result", stumble)
    with pytest.raises(ZeroDivisionError):
        bench.send(worker, result(first.digest), result(second.digest))
    assert first.digest in bench.run.fleet.jobs, "its worker repeats it"
    assert second.digest not in bench.run.fleet.jobs
    monkeypatch.undo()
    bench.send(worker, result(first.digest), result(second.digest))
    assert bench.run.generation.complete


def test_an_exception_while_a_result_is_counted_ends_the_incarnation_and_the_next_one_loses_nothing(bench, monkeypatch):
    (worker, first), (_, second) = given_jobs(bench)

    monkeypatch.setattr(bench.run.generation, "record", lambda *_: 1 / 0)
    with pytest.raises(InternalError, match=r"ZeroDivisionError.*--resume"):
        bench.send(worker, result(first.digest))
    bench.restart()
    bench.send(worker, result(first.digest), result(second.digest))
    assert bench.run.generation.complete


def test_a_malformed_hello_is_refused_and_a_hello_with_a_known_reason_admits_nobody(bench):
    assert not bench.worker_protocol.answer_hello(None, None, bench.now).accepted
    bench.run.fleet.remove_worker(B)
    refused = bench.worker_protocol.answer_hello(bench.request(B), Refusal("no " * 10_000, "wait"), bench.now)
    assert (refused.accepted, refused.remedy, refused.spec) == (False, "wait", {})
    assert len(refused.why) <= MAX_TEXT
    assert B not in bench.run.fleet.members
    welcome = bench.worker_protocol.answer_hello(bench.request(B), None, bench.now)
    assert (welcome.accepted, welcome.numbering) == (True, bench.run.fleet.members[B].numbering)


def test_a_message_for_another_run_is_dropped(bench):
    (worker, job), _ = given_jobs(bench)
    batch = ResultBatch(run_uid="0" * 32, incarnation=1, fingerprint="f", results=(result(job.digest),))
    bench.worker_protocol.handle(worker, batch, bench.now)
    assert bench.run.dropped == {"foreign run": 1}
    assert job.digest in bench.run.fleet.jobs
