"""When a worker says hello again, drains and leaves."""

import math
from itertools import product

from dreamfleet.worker.service.membership import (
    NEXT_RUN_AFTER,
    NEXT_RUN_TIMEOUT,
    SEARCH_INTERVAL,
    SILENT_BEATS,
    SINGLE_RUN_DELAYS,
    UPLOAD_GRACE,
    LeaveConditions,
    Membership,
    RefusalBackoff,
    WorkerLoad,
)

BEAT = 1.0
SILENCE = SILENT_BEATS * BEAT
TIMEOUT = 60.0  # of a coordinator out of sight
LOADS = [WorkerLoad(*each) for each in product((True, False), repeat=3)]  # idle, awaits a verdict, uploads


def joined(visible=True, **terms):
    """A member at time 0, in the first incarnation of its coordinator."""
    made = Membership(LeaveConditions(**terms), now=0.0)
    made.join("first", BEAT, now=0.0)
    if visible:
        made.add_coordinator("first")
    return made


def test_it_leaves_a_run_that_ends_at_once_and_not_the_next_one():
    member = joined()
    member.end_run("the run has ended")
    assert member.run_is_over == member.find_end(1.0, busy=True) == "the run has ended"
    member.join("another run's", BEAT, now=2.0)
    assert not member.run_is_over
    assert not member.find_end(3.0, busy=False)


def test_a_coordinator_is_back_if_it_is_in_the_same_life():
    member = joined()
    member.remove_coordinator("first", 1.0)
    assert [member.add_coordinator("first") for _ in range(2)] == [True, False]
    member.remove_coordinator("first", 1.0)
    assert not member.add_coordinator("second")


def test_it_says_hello_to_one_in_sight_that_is_silent_while_it_owes_an_answer_is_new_or_was_out_of_sight():
    member = joined()
    for load in LOADS:
        patience = SILENCE + (UPLOAD_GRACE if load.uploading else 0.0)
        for now in (SILENCE, SILENCE + 0.1, SILENCE + UPLOAD_GRACE, SILENCE + UPLOAD_GRACE + 0.1):
            assert member.must_rejoin(now, load) == (now > patience and (load.idle or load.awaits_verdict))
    member.note_activity(100.0)
    assert not any(member.must_rejoin(100.0 + SILENCE, load) for load in LOADS)
    member.add_coordinator("second")
    member.remove_coordinator("second", 100.0)
    assert not any(member.must_rejoin(100.0, load) for load in LOADS), "it was another's"
    member.remove_coordinator("first", 100.0)
    assert not any(member.must_rejoin(math.inf, load) for load in LOADS), "nobody would answer"
    for nonce in ("first", "second"):  # it was out of sight; then another incarnation is there
        member.add_coordinator(nonce)
        member.remove_coordinator("third", 100.0)
        assert all(member.must_rejoin(100.0, load) for load in LOADS)
        member.note_hello_sent(100.0, pause=2.0)
        assert not any(member.must_rejoin(101.9, load) for load in LOADS), "it never asks without a pause"
        assert all(member.must_rejoin(102.0, load) for load in LOADS)
        member.rejoin(nonce, 102.0)
        assert not any(member.must_rejoin(102.0 + SILENCE, load) for load in LOADS)
        member.remove_coordinator(nonce, 103.0)
        member.note_hello_sent(100.0, pause=0.0)
    member.add_coordinator("second")
    member.rejoin("second", 104.0)
    member.suspect_forgotten()
    assert all(member.must_rejoin(104.0, load) for load in LOADS), "its batches have a newer numbering"


def test_it_looks_for_its_run_in_intervals_while_no_coordinator_is_in_sight():
    member = joined()
    assert not member.start_search_if_due(1e6), "one is in sight"
    member.remove_coordinator("first", 1e6)
    assert not member.start_search_if_due(1e6 + SEARCH_INTERVAL - 0.1)
    assert member.start_search_if_due(1e6 + SEARCH_INTERVAL)
    assert not member.start_search_if_due(1e6 + SEARCH_INTERVAL)
    assert member.start_search_if_due(1e6 + 2 * SEARCH_INTERVAL)


def test_it_drains_once_its_join_file_ends_by_the_wall_clock_however_little_time_it_was_awake():
    left = [1.0]
    member = joined(is_expired=lambda: left[0] <= 0)
    assert not member.start_draining_if_due(1.0)
    left[0] = -1.0
    assert member.start_draining_if_due(1.0)


def test_only_a_worker_that_leaves_with_its_run_gives_its_coordinator_up_and_only_after_long_patience():
    leaves, stays = joined(leaves_with_run=True, coordinator_timeout=TIMEOUT), joined(coordinator_timeout=TIMEOUT)
    for member in (leaves, stays):
        assert not member.find_end(1e6, busy=False)
        member.remove_coordinator("first", 1e6)
        member.remove_coordinator("second", 1e6 + 9.0)
        assert not member.find_end(1e6 + TIMEOUT, busy=False), "it waits for a restart although it has nothing"
        assert not member.gives_up(1e6 + TIMEOUT)
    assert leaves.find_end(1e6 + TIMEOUT + 0.1, busy=True)
    assert leaves.gives_up(1e6 + TIMEOUT + 0.1)
    assert not stays.find_end(math.inf, busy=False)
    leaves.add_coordinator("second")
    assert not leaves.find_end(math.inf, busy=True)


def test_a_worker_of_any_run_goes_on_soon_but_not_at_once_with_results():
    member = joined(serves_any=True)
    member.remove_coordinator("first", 0.0)
    assert not member.find_end(NEXT_RUN_AFTER, busy=False)
    assert member.find_end(NEXT_RUN_AFTER + 0.1, busy=False)
    assert not member.find_end(NEXT_RUN_TIMEOUT, busy=True)
    assert member.find_end(NEXT_RUN_TIMEOUT + 0.1, busy=True)
    assert not member.gives_up(math.inf), "that is no failure"


def test_stopped_once_it_drains_until_all_is_delivered_and_names_why():
    member, expired = joined(drain_timeout=30.0), joined(lifetime=1.0)
    assert not member.start_draining_if_due(1.0)
    member.stop()
    for each in (member, expired):
        assert each.start_draining_if_due(1.0)
        assert not each.start_draining_if_due(1.1), "it begins once"
        assert (each.is_leaving(1.1), each.draining) == (True, True)
    assert not member.find_end(31.0, busy=True)
    assert "" != expired.find_end(1.1, busy=False) != member.find_end(1.1, busy=False) != ""
    assert "--drain-timeout" in member.find_end(31.1, busy=True)
    for each in (member, expired):
        each.remove_coordinator("first", 2.0)
        assert not each.find_end(2.0 + SEARCH_INTERVAL, busy=True)
    assert member.find_end(2.1 + SEARCH_INTERVAL, busy=True), "nobody takes what is left"
    assert not expired.find_end(2.1 + SEARCH_INTERVAL, busy=True), "unless it is stopped, it waits for its coordinator"
    expired.stop()
    expired.stop()
    assert expired.find_end(1.1, busy=True), "two signals are not drained"


def test_a_worker_that_drains_does_not_give_its_coordinator_up():
    member = joined(visible=False, leaves_with_run=True, coordinator_timeout=TIMEOUT, lifetime=TIMEOUT)
    assert not member.gives_up(TIMEOUT + 0.1)
    assert not member.find_end(TIMEOUT + 0.1, busy=True)
    assert not member.is_leaving(TIMEOUT - 0.1)


def test_runs_that_refused_are_asked_again_each_with_its_own_growing_pauses_until_it_accepts():
    refusals, now = RefusalBackoff(*SINGLE_RUN_DELAYS), 0.0
    for pause in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0):
        assert refusals.add("night", now) == pause
        assert refusals.refusing_runs(now + pause - 0.1) == {"night"}
        now += pause
        assert refusals.refusing_runs(now) == set()
    assert [refusals.add(run, now) for run in ("day", "night")] == [1.0, 60.0]
    assert [refusals.is_news("night", why) for why in "aabba"] == [True, False, True, False, True]
    assert refusals.is_news("day", "a")
    refusals.forget("night")
    assert refusals.refusing_runs(now) == {"day"}
    assert refusals.add("night", now) == 1.0
