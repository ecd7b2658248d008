"""The event log: the bounded log alone, and the events that a fleet writes into it."""

import pytest

from dreamfleet.common.client.status import WorkerCount, read_status
from dreamfleet.common.protocol.messages import Result
from dreamfleet.coordinator.addons.metrics.prometheus import exposition
from dreamfleet.coordinator.dispatch.event_log import MAX_EVENTS, EventLog, latest
from dreamfleet.coordinator.dispatch.fleet import DEPARTURE_GRACE, SILENT_AFTER
from tests.support.run_bench import A, B, Bench
from tests.support.snapshots import SCORED, answered, score, snapshot_of


@pytest.fixture
def bench(make_bench):
    return make_bench(Bench, SCORED, generations=3)


def events(bench, **asked):
    return [
        (each["what"], each["worker"], each["job"]) for each in answered(snapshot_of(bench), "story", **asked)["story"]
    ]


def test_the_log_is_bounded_and_a_view_does_not_change():
    event_log = EventLog()
    for number in range(MAX_EVENTS + 10):
        event_log.now = float(number)
        event_log.add("back", "a/0")
    view = event_log.view()
    assert len(view) == MAX_EVENTS
    assert next(latest(view)).at == MAX_EVENTS + 9
    event_log.add("left", "a/0")
    assert next(latest(view)).what == "back"


def test_a_jobs_story_goes_from_given_to_accepted(bench):
    score(bench, 1)
    (name,) = [job for what, _, job in events(bench, job="0/0") if what == "accepted"]
    assert name.startswith("score 0/0/")
    assert [what for what, _, job in events(bench, job="0/0") if job == name] == ["given", "accepted"]
    assert {job.split()[1].rpartition("/")[0] for _, _, job in events(bench, job="0/1")} == {"0/1"}


def test_jobs_of_a_silent_worker_are_logged_as_given_again(bench):
    sends = bench.run.fleet.dispatch(bench.now)
    held = sum(len(send.work) for send in sends if send.identity == A)
    bench.handle_heartbeat(A)
    bench.now += SILENT_AFTER + 0.1
    bench.handle_heartbeat(B)
    bench.run.tick(bench.now)
    whats = [what for what, _, _ in events(bench, worker=A)]
    assert whats[:1] == ["joined"]
    assert whats.count("given") == whats.count("seen") == whats.count("reissued") == held > 0
    assert "silent" in whats
    bench.handle_heartbeat(A)
    assert events(bench, worker="a")[-1][:2] == ("back", A)


def test_a_worker_that_vanishes_is_logged_and_an_unknown_sender_is_not(bench):
    bench.run.fleet.handle_departure(B, bench.now)
    bench.wait(2 * DEPARTURE_GRACE)
    assert ("lost", B, "") in events(bench)
    status = read_status(answered(snapshot_of(bench)))
    assert (status.workers, status.worker_list[-1].worker) == (WorkerCount(1, 2, 1), B)
    assert (status.worker_list[-1].state, status.worker_list[-1].leases) == ("lost", 0)
    assert b'dreamfleet_workers{run="night",which="lost"} 1.0' in exposition(status)
    assert [what for what, _, _ in events(bench, what="lost,joined")] == ["joined", "joined", "lost"]
    before = len(events(bench))
    bench.deliver("stranger/00000009", Result(b"x" * 32, 1.0, 10, 0.1, None, None))
    assert len(events(bench)) == before


def test_unknown_workers_and_jobs_have_no_events_and_a_generation_alone_means_all(bench):
    bench.run.fleet.dispatch(bench.now)
    assert not any(events(bench, **each) for each in ({"worker": "nobody"}, {"job": "9/9"}, {"job": "x/y"}))
    assert events(bench, job="7")
