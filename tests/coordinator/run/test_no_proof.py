"""R8: only suspects are open, and no scored job is left that could show whether a new host can score."""

from dataclasses import replace

import pytest

from dreamfleet.common.protocol.messages import Result
from dreamfleet.common.protocol.stop_kind import PauseKind
from dreamfleet.coordinator.run.recall import recall
from tests.support.failing_runs import SETTINGS, pause_kinds
from tests.support.failures import failure
from tests.support.run_bench import A, B

NEW = "new/1"


def serve_alone(bench, name, until):
    """Let one host score until a generation is open; the other is gone."""
    for other in [each for each in bench.run.fleet.members if each != name]:
        bench.run.fleet.remove_worker(other)
    bench.hosts = [name]
    bench.run.admission.admit(bench.request(name), bench.now)
    bench.serve(stop=lambda run: run.generation.number == until)


@pytest.fixture
def left(begin):
    """The host of generation 0 lost two workers with all jobs of generation 1, whose former scores were recalled."""
    settings = replace(SETTINGS, population=2, episodes=1)
    bench = begin(settings=settings)
    serve_alone(bench, A, 1)
    serve_alone(bench, B, 2)
    recall(bench.journal, settings, {"b"})
    bench.journal.commit()
    bench.restart()
    bench.run.fleet.remove_worker(B)
    for life in (A, "a/00000009"):
        bench.run.admission.admit(bench.request(life), bench.now)
        bench.handle_heartbeat(life, host_class=bench.host_class)
        assert len(bench.run.fleet.dispatch(bench.now)[0].work) == 2
        bench.run.fleet.handle_departure(life, bench.now)
        bench.wait()
        bench.run.advance(bench.now)
    assert all(each.is_suspect for each in bench.run.fleet.jobs.values())
    bench.hosts = [NEW]
    bench.run.admission.admit(bench.request(NEW), bench.now)
    return bench


def test_a_new_host_gets_the_suspects_when_the_only_host_that_has_scored_is_gone(left):
    left.serve()
    assert left.run.state.ended
    assert [each.failed for each in left.run.history.rows] == [0, 0, 0]


def test_a_new_host_that_fails_them_all_pauses_the_run(left):
    left.answer_one = lambda name, job: left.deliver(
        name, Result(job.digest, None, 0, 0.1, failure("OSError", "sick"), None)
    )
    left.serve()
    assert pause_kinds(left) == [PauseKind.NO_ABLE_HOST]
    assert left.run.generation.failed == []
