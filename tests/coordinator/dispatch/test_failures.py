"""What failed attempts prove. R8: which worker gets a job that may have ended its workers, and how a new host shows
that it can score.

Tests failure_judge.py, pending_jobs.py and worker_selection.py.
"""

import pytest

from dreamfleet.common.protocol.failures import Failure
from dreamfleet.coordinator.dispatch.failure_judge import is_lasting
from dreamfleet.coordinator.dispatch.failures import LONGEST_PAUSE, Attempt, pause_before_retry
from tests.support.dispatched import A, B, digests, fleet_of, result
from tests.support.failures import failure

OTHER_A = "a/00000002"
WORKS = {"a", "b"}  # hosts that have scored
SHORTAGE = Failure.of_host("killed by SIGKILL")


def attempts(*rows):
    return [Attempt(worker, error) for worker, error in rows]


@pytest.mark.parametrize(
    ("rows", "untried", "lasting"),
    [
        ([(A, failure("NaN score"))], True, False),
        ([(A, failure("NaN score"))], False, False),
        ([(A, failure("ValueError", "at 0x1")), (B, failure("ValueError", "at 0x2"))], True, True),
        ([(A, failure("ValueError", "1")), (A, failure("ValueError", "2"))], False, True),
        ([(A, failure("ValueError", "1")), (OTHER_A, failure("ValueError", "2"))], True, False),
        ([(A, failure("ValueError", "1")), (B, failure("KeyError", "2"))], False, False),
        (
            [(A, failure("ValueError", "1")), (B, failure("KeyError", "2")), (A, failure("IndexError", "3"))],
            False,
            True,
        ),
        ([(A, SHORTAGE), (B, SHORTAGE)], False, False),
        ([(A, SHORTAGE)] * 9, False, False),
        ([(A, SHORTAGE)] * 10, False, True),
        ([(A, failure("ObjectiveError", "cost returned nan"))], False, False),
        ([(A, SHORTAGE), (B, failure("NaN score")), (A, SHORTAGE), (A, failure("NaN score"))], False, True),
    ],
)
def test_two_equal_failures_on_two_hosts_where_there_are_two_show_that_the_episode_fails(rows, untried, lasting):
    assert is_lasting(attempts(*rows), WORKS, {"c"} if untried else ()) is lasting


def test_a_host_that_has_scored_nothing_proves_nothing():
    rows = [("new/1", failure("ImportError", "libGL")), ("newer/1", failure("ImportError", "libGL"))]
    assert not is_lasting(attempts(*rows * 9), WORKS, ())
    assert not is_lasting(attempts(*rows, (A, failure("ImportError", "libGL"))), WORKS, ())


def test_attempts_wait_longer_and_longer():
    assert [pause_before_retry(count) for count in range(5)] == [0.0, 0.0, 1.0, 2.0, 4.0]
    assert pause_before_retry(10**6) == LONGEST_PAUSE


ENDED = ["x/00000003", "y/00000004"]  # they ended while they held the suspect
C = "c/00000005"


def fleet_with_suspect(*names):
    """A has scored one of two jobs and failed the other, a suspect; then the other workers joined. And both jobs."""
    fleet = fleet_of(A, jobs=2)
    scored, suspect = digests(fleet.dispatch(0.0), A)
    fleet.jobs[suspect].lost_with += tuple(ENDED)
    control = fleet.jobs[scored].work
    fleet.handle_result(A, result(scored), 0.1)
    fleet.handle_result(A, result(suspect, error=failure("OSError", "once")), 0.2)
    for name in names:
        fleet.members.update({name: fleet_of(name, jobs=0).members[name]})
        fleet.members[name].last_heard = 0.3
    return fleet, control, suspect


@pytest.mark.parametrize("has_scored", [False, True])
def test_a_suspect_goes_to_another_host_if_that_has_scored_else_where_it_failed(has_scored):
    fleet, _, suspect = fleet_with_suspect(B)
    fleet.failure_judge.working_hosts |= {"b"} if has_scored else set()
    sends = fleet.dispatch(0.4)
    assert digests(sends, B if has_scored else A) == [suspect]
    assert digests(sends, A if has_scored else B) == []


def test_a_host_that_has_not_scored_gets_the_job_that_was_scored_before_and_no_other_a_copy():
    fleet, control, suspect = fleet_with_suspect(B)
    assert fleet.failure_judge.awaits_control_job
    assert fleet.jobs.offer_control_job(control)
    sends = fleet.dispatch(0.4)
    assert digests(sends, A) == [suspect]
    assert digests(sends, B) == [control.job.digest]
    fleet.handle_result(A, result(suspect), 0.5)
    assert digests(fleet.dispatch(0.6), A) == []
    fleet.handle_result(B, result(control.job.digest), 0.7)
    assert fleet.failure_judge.working_hosts == {"a", "b"}
    assert not fleet.jobs


def test_the_job_that_was_scored_before_goes_to_any_host_once_all_that_are_here_have_scored():
    fleet, control, suspect = fleet_with_suspect()
    fleet.jobs.offer_control_job(control)
    assert sorted(digests(fleet.dispatch(0.4), A)) == sorted([suspect, control.job.digest])


def test_a_host_that_failed_what_another_has_scored_holds_up_no_judgement():
    fleet, control, suspect = fleet_with_suspect(B)
    fleet.jobs.offer_control_job(control)
    fleet.dispatch(0.4)
    fleet.handle_result(A, result(suspect, error=failure("OSError", "twice")), 0.5)
    assert fleet.failure_judge.find_lasting() == [], "B may show that it can score"
    fleet.handle_result(B, result(control.job.digest, error=failure("ImportError", "broken")), 0.6)
    (lasting,) = fleet.failure_judge.find_lasting()
    assert lasting.work.job.digest == suspect


@pytest.mark.parametrize("gone", [False, True])
def test_a_host_that_fails_what_another_has_scored_pauses_only_a_run_without_that_other(gone):
    fleet, control, _ = fleet_with_suspect(B, C)
    fleet.jobs.offer_control_job(control)
    for moment in (0.4, 0.5):
        sends = fleet.dispatch(moment)
        for name in (B, C):
            for digest in digests(sends, name):
                fleet.handle_result(name, result(digest, error=failure("ImportError", "broken")), moment)
    if gone:
        fleet.remove_worker(A)
    paused = fleet.failure_judge.find_pausing()
    assert (paused and paused.work) == (control if gone else None)


def test_a_new_host_gets_a_suspect_only_where_no_host_that_has_scored_is_here_and_no_job_could_show_that_it_can():
    fleet, _, suspect = fleet_with_suspect(B)
    fleet.failure_judge.lacks_control_job = True
    assert digests(fleet.dispatch(0.4), B) == [], "A is here, which has scored"
    fleet.remove_worker(A)
    assert digests(fleet.dispatch(0.5), B) == [suspect]


def test_a_new_host_waits_for_the_job_that_shows_that_it_can_score():
    fleet, control, _ = fleet_with_suspect(B)
    fleet.remove_worker(A)
    assert digests(fleet.dispatch(0.4), B) == []
    fleet.jobs.offer_control_job(control)
    assert digests(fleet.dispatch(0.5), B) == [control.job.digest]


def test_a_new_host_shows_that_it_can_score_as_soon_as_only_failed_jobs_are_open():
    """Else its attempts would prove nothing, and the host that has scored would have to fail again, minutes later."""
    fleet, control, failed = fleet_with_suspect(B)
    fleet.jobs[failed].lost_with = ()
    assert fleet.failure_judge.awaits_control_job
    assert fleet.jobs.offer_control_job(control)
    assert not fleet.failure_judge.awaits_control_job
