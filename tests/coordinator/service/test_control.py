"""Control verbs, without a transport."""

import re

import pytest

from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.stop_kind import PauseKind
from dreamfleet.coordinator.run.failure_policy import LIMIT_FROM
from dreamfleet.coordinator.run.run import BY_HAND, PAUSED
from dreamfleet.coordinator.run.run_state import Pause
from dreamfleet.coordinator.service.control import DISBAND_TIMEOUT, DRAINING, Control
from tests.support.run_bench import A, B, Bench

AGAIN = "dreamfleet coordinator --resume night"


class Controlled(Bench):
    def begin(self):
        super().begin()
        self.stopped = False
        self.control = Control(self.run, "night", 1.0, self.stop)

    def stop(self):
        self.stopped = True

    def obey(self, verb, host=""):
        return self.control.obey(keys.control("night", verb), AGAIN, self.now, host)


@pytest.fixture
def bench(make_bench):
    return make_bench(Controlled)


def test_a_known_verb_is_obeyed_and_one_that_ends_the_coordinator_names_the_command_that_continues(bench):
    assert bench.obey("pause").accepted
    assert (bench.run.state.paused.pauses, bench.obey("pause").again) == ((BY_HAND,), "")
    assert bench.obey("resume").accepted
    assert bench.run.state.paused is None
    assert (bench.obey("stop").again, bench.stopped) == (AGAIN, True)


def test_a_pause_by_hand_does_not_hide_why_the_run_was_paused(bench):
    failures = Pause(PauseKind.FAILED_CANDIDATES, "by hand")  # its words do not matter
    bench.run.pause(failures)
    for _ in range(2):
        assert bench.obey("pause").accepted
        assert bench.run.state.paused.pauses == (BY_HAND, failures)
    for _ in range(2):
        assert bench.obey("drain").accepted
        assert bench.obey("pause").accepted
        assert bench.run.state.paused.pauses == (BY_HAND, DRAINING, failures)
    bench.obey("resume")
    bench.obey("pause")
    assert bench.run.state.paused.pauses == (BY_HAND,)


def test_a_run_whose_results_are_being_recalled_resumes_in_its_next_life_only(bench):
    """What this incarnation holds is true no more, so nothing of it may reach the journal or a worker."""
    bench.run.pause(BY_HAND)
    bench.run.keep_paused()
    assert bench.obey("bar", "a").accepted
    assert not bench.obey("resume").accepted
    assert bench.run.fleet.paused
    assert bench.journal.fact(PAUSED) is not None
    assert bench.journal.fact(LIMIT_FROM) is None
    bench.restart()
    assert bench.obey("resume").accepted
    assert bench.run.state.paused is None


def test_an_unknown_verb_and_one_for_several_runs_change_nothing(bench):
    unknown, wild = bench.obey("halt"), bench.control.obey(keys.control("*", "stop"), AGAIN, bench.now)
    assert not unknown.accepted
    assert re.search("'halt'.* pause, resume", unknown.why)
    assert (wild.accepted, wild.again, bench.stopped) == (False, "", False)


def test_a_drained_run_stops_once_no_worker_holds_a_job_and_bars_nobody(bench):
    bench.run.fleet.dispatch(bench.now)
    bench.obey("drain")
    bench.control.advance(bench.now)
    assert not bench.stopped
    assert bench.obey("bar", "a").why
    assert not bench.run.admission.barred
    for name in (A, B):
        bench.run.fleet.remove_worker(name)
    bench.control.advance(bench.now)
    assert bench.stopped


def test_a_disbanded_run_asks_its_workers_to_leave_at_each_beat_until_they_have_or_too_long(bench):
    bench.obey("disband")
    assert [each.identity for each in bench.control.advance(bench.now)] == [A, B]
    assert bench.control.advance(bench.now + 0.5) == []
    (batch, _), _ = bench.control.advance(bench.now + 1.0), bench.run.fleet.handle_departure(A, bench.now)
    assert bench.worker_protocol.job_batch(batch, leave=bench.control.disbanding).leave
    assert [each.identity for each in bench.control.advance(bench.now + 2.0)] == [B]
    assert not bench.stopped
    bench.control.advance(bench.now + DISBAND_TIMEOUT + 1.0)
    assert bench.stopped


def test_the_operator_bars_a_host_and_lets_it_in_again_and_a_misspelt_one_changes_nothing(bench):
    assert "a, b" in bench.obey("bar", "c").why
    assert bench.obey("bar").why
    assert bench.obey("unbar", "a").why
    assert not bench.run.state.is_rewound
    assert bench.obey("bar", "a").accepted
    assert bench.run.state.is_rewound
    assert bench.obey("bar", "b").why
    bench.run.commit()
    bench.restart()
    (begun,) = bench.journal.read_row("SELECT text FROM event WHERE text LIKE 'incarnation 2%'")
    assert "killed" not in begun
    assert [*bench.run.admission.barred] == ["a"]
    assert "--no-longer" in bench.run.admission.find_refusal(bench.request(A)).remedy
    summary = bench.run.verification.summary
    assert (summary.barred, summary.by_operator) == (("a",), ("a",))
    assert bench.obey("bar", "a").why
    assert bench.obey("unbar", "a").accepted
    assert not bench.run.state.is_rewound
    assert bench.run.admission.find_refusal(bench.request(A)) is None
    bench.run.commit()
    bench.restart()
    assert bench.run.admission.find_refusal(bench.request(A)) is None
