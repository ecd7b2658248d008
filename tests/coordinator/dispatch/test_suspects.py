"""R8: which worker gets a job that may have ended its workers, and how a new host shows that it can score."""

import pytest

from tests.support.dispatched import A, B, digests, fleet_of, result
from tests.support.failures import failure

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
        join(fleet, name, 0.3)
    return fleet, control, suspect


def join(fleet, name, now):
    fleet.members.update({name: fleet_of(name, jobs=0).members[name]})
    fleet.members[name].last_heard = now


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
