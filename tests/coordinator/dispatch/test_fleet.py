"""Tests fleet.py, leases.py, member.py, pending_jobs.py and speculative_execution.py."""

import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from dreamfleet.common.protocol.messages import MAX_SLOTS, Result
from dreamfleet.coordinator.dispatch.event_log import latest
from dreamfleet.coordinator.dispatch.fleet import (
    DEPARTURE_GRACE,
    FORGET_AFTER,
    MAX_UNCONFIRMED,
    SILENT_AFTER,
    UNCONFIRMED_TIMEOUT,
)
from dreamfleet.coordinator.dispatch.member import DEPARTED_TIMEOUT, MAX_DEPARTED, MOST_VERDICTS
from dreamfleet.coordinator.dispatch.speculative_execution import LONGEST_HELD, LONGEST_HELD_TIMES, UPLOAD_SECONDS
from dreamfleet.coordinator.jobs.scoring_job import make_jobs, vector_bytes
from tests.support.dispatched import BEAT, A, B, Fleet, beat, digests, fleet_of, join, result, work
from tests.support.failures import failure
from tests.support.samples import SPEC


def numbered(sends):
    """Without the empty batches that only show that the coordinator is there."""
    return [send for send in sends if send.number]


def cancelled(sends, name):
    return [digest for send in sends if send.identity == name for digest in send.cancels]


def test_credit_is_twice_the_capacity_from_the_first_heartbeat_on_and_a_result_returns_it():
    fleet = Fleet(BEAT)
    fleet.jobs.offer(work(10))
    fleet.add_worker(A, 2, "f", 0.0)
    assert fleet.dispatch(0.0) == []
    fleet.handle_heartbeat(A, beat(2), 0.0)
    given = digests(fleet.dispatch(0.0), A)
    assert len(given) == 4
    assert fleet.dispatch(0.1) == []
    fleet.handle_result(A, result(given[0]), 0.2)
    (send,) = fleet.dispatch(0.2)
    assert len(send.work) == 1
    assert [(verdict.digest, verdict.verdict) for verdict in send.verdicts] == [(given[0], "accepted")]


@pytest.mark.parametrize(("driven", "together", "given"), [(None, 1, 50), (True, 1, 4), (True, 4, 16)])
def test_of_drives_a_wide_worker_is_given_as_many_as_its_slots_do_at_once_and_once_more(driven, together, given):
    fleet = fleet_of(A, jobs=0)
    spec = SPEC.with_overrides(driven=driven)
    fleet.jobs.offer(make_jobs(spec, "score", 0, 0, vector_bytes(np.arange(4.0)), range(1000, 1050), SPEC))
    fleet.handle_heartbeat(A, replace(beat(capacity=200), slots=2, side_by_side=together), 1.0)
    assert len(digests(fleet.dispatch(1.0), A)) == given


def test_as_drives_run_out_a_job_that_waits_behind_one_goes_to_an_idle_slot():
    fleet = fleet_of(A, jobs=0)
    fleet.handle_heartbeat(A, replace(beat(4), slots=1, side_by_side=4), 0.0)
    fleet.jobs.offer(work(2, generation=1))
    first, second = digests(fleet.dispatch(0.0), A)
    fleet.add_worker(B, 1, "f", 1.0)
    fleet.handle_heartbeat(B, replace(beat(4), slots=1, side_by_side=4), 1.0)
    shown = beat(4, seen=1, queued=[second], running=[first])
    fleet.handle_heartbeat(A, replace(shown, slots=1, side_by_side=4), 1.1)
    sends = fleet.dispatch(1.1)
    assert digests(sends, B) == [second]
    assert cancelled(sends, A) == [second]


def test_the_first_wanted_result_wins_and_the_others_copy_is_cancelled():
    fleet = fleet_of(A, B, jobs=1)
    (digest,) = digests(fleet.dispatch(0.0), A)
    fleet.handle_departure(A, 0.1)
    fleet.tick(0.2)
    assert digests(fleet.dispatch(0.2), B) == [digest]
    fleet.add_worker(A, 1, "f", 0.3)
    assert fleet.handle_result(A, result(digest), 0.3)[0] == "accepted"
    assert [send.cancels for send in fleet.dispatch(0.3) if send.identity == B] == [[digest]]
    assert fleet.handle_result(B, result(digest), 0.4)[0] == "duplicate"
    assert fleet.handle_result(B, result(b"x" * 32), 0.4)[0] == "obsolete"


def test_a_departed_workers_jobs_are_given_again_after_the_grace():
    fleet = fleet_of(A, B, jobs=2)
    (digest,) = digests(fleet.dispatch(0.0), A)
    fleet.handle_departure(A, 1.0)
    fleet.tick(1.0 + DEPARTURE_GRACE / 2)
    assert fleet.dispatch(1.0) == []
    fleet.tick(1.0 + DEPARTURE_GRACE)
    assert digests(fleet.dispatch(1.1), B) == [digest]
    assert A not in fleet.members


def test_a_worker_that_vanishes_without_leaving_is_listed_as_lost_until_it_is_back_or_for_minutes():
    fleet = fleet_of(A, B)

    def vanish(name, now):
        fleet.handle_departure(name, now)
        fleet.tick(now + 2 * DEPARTURE_GRACE)

    vanish(A, 1.0)
    fleet.handle_heartbeat(B, beat(0), 2.0)  # it drains
    vanish(B, 2.0)
    assert list(fleet.departed) == [A]
    assert [each.what for each in latest(fleet.event_log.view())][:2] == ["left", "lost"]
    fleet.add_worker(A, 1, "f", 3.0)
    assert list(fleet.departed) == [A]  # anybody may say hello
    fleet.handle_heartbeat(A, beat(), 3.0)
    assert (fleet.departed, next(latest(fleet.event_log.view())).what) == ({}, "back")
    vanish(A, 4.0)
    another_life = "a/00000009"
    join(fleet, another_life, 5.0)
    assert not fleet.departed
    vanish(another_life, 6.0)
    fleet.tick(6.0 + DEPARTED_TIMEOUT)
    assert not fleet.departed


def test_a_worker_that_says_why_it_leaves_is_listed_with_that_and_its_jobs_are_free():
    fleet = fleet_of(A, B, jobs=1)
    (digest,) = digests(fleet.dispatch(0.0), A)
    fleet.handle_heartbeat(A, beat(0, seen=1, queued=[digest], reason="no\nroom\x1b[2J"), 1.0)
    fleet.handle_departure(A, 1.0)
    fleet.tick(1.0 + 2 * DEPARTURE_GRACE)
    assert digests(fleet.dispatch(1.2), B) == [digest]
    gone = fleet.departed[A]
    assert (gone.farewell, gone.is_lost) == ("no room\\x1b[2J", False)
    event = next(each for each in latest(fleet.event_log.view(), A) if each.what == "left")
    assert event.why == gone.farewell
    assert gone.farewell in fleet.notes[-1].text
    join(fleet, A, 3.0)
    assert not fleet.departed, "it is back"


def test_an_unconfirmed_worker_that_cannot_score_says_why_in_its_first_heartbeat():
    fleet = fleet_of(B, jobs=1)
    fleet.add_worker(A, 1, "f", 1.0)
    fleet.handle_heartbeat(A, beat(0, reason="no environment"), 1.0)
    fleet.tick(1.0 + 2 * DEPARTURE_GRACE)
    assert list(fleet.departed) == [A]
    assert A not in fleet.members
    fleet.handle_heartbeat("stranger/00000009", beat(0, reason="filling the list"), 2.0)
    fleet.tick(3.0)
    assert list(fleet.departed) == [A]


def test_an_unknown_senders_farewell_in_the_name_of_a_live_worker_ends_with_its_next_heartbeat():
    fleet = fleet_of(A)
    fleet.handle_heartbeat(A, beat(0, reason="forged"), 1.0)
    fleet.tick(1.0 + 2 * DEPARTURE_GRACE)
    fleet.handle_heartbeat(A, beat(), 2.0)
    assert fleet.members[A].takes_jobs
    assert not fleet.members[A].farewell


@pytest.mark.parametrize(
    ("last", "scorer", "wasted"), [("running", B, 4), ("unacked", B, 10), ("queued", B, 0), ("unacked", A, 0)]
)
def test_what_a_lost_worker_had_done_of_a_job_is_waste_once_another_has_scored_it(last, scorer, wasted):
    fleet = fleet_of(A, jobs=1)
    (digest,) = digests(fleet.dispatch(0.0), A)
    fleet.handle_heartbeat(A, beat(seen=1, steps=4, **{last: [digest]}), 1.0)
    fleet.handle_departure(A, 1.0)
    fleet.tick(2.0)
    join(fleet, scorer, 2.0)
    assert digests(fleet.dispatch(2.0), scorer) == [digest]
    assert fleet.counts["discarded_steps"] == 0
    fleet.handle_result(scorer, result(digest), 3.0)
    assert fleet.counts["discarded_steps"] == wasted


def test_a_failed_job_is_wasted_once():
    fleet = fleet_of(A, B, jobs=1)
    (digest,) = digests(fleet.dispatch(0.0), A)
    fleet.handle_heartbeat(A, beat(seen=1, steps=4, running=[digest]), 1.0)
    fleet.handle_result(A, result(digest, error=failure("it broke")), 1.0)
    fleet.dispatch(1.0)
    fleet.handle_result(B, result(digest), 2.0)
    assert fleet.counts["discarded_steps"] == 10


def test_the_list_of_lost_workers_is_bounded():
    fleet = fleet_of(*(f"h{number}/0" for number in range(MAX_DEPARTED + 3)))
    for name in list(fleet.members):
        fleet.handle_departure(name, 1.0)
    fleet.tick(1.0 + 2 * DEPARTURE_GRACE)
    assert len(fleet.departed) == MAX_DEPARTED
    assert "h0/0" not in fleet.departed


def test_a_silent_workers_jobs_are_given_again_and_a_heartbeat_brings_it_back():
    fleet = fleet_of(A, B, jobs=2)
    (digest,) = digests(fleet.dispatch(0.0), A)
    late, before = SILENT_AFTER * BEAT + 0.1, fleet.members[A].numbering
    for step in range(1, 6):
        fleet.handle_heartbeat(B, beat(seen=1, running=digests([], B)), float(step))
        fleet.tick(float(step))
    fleet.handle_heartbeat(B, beat(seen=1), late)
    fleet.tick(late)
    assert fleet.members[A].silent
    assert digest in digests(fleet.dispatch(late), B)
    fleet.handle_heartbeat(A, beat(numbering=before, seen=1, running=[digest]), late + 1)
    assert not fleet.members[A].silent
    assert digest in fleet.members[A].leases
    fleet.jobs.offer(work(1, generation=1))
    (send,) = [send for send in fleet.dispatch(late + 1) if send.identity == A]
    assert (send.numbering > before, send.number, len(send.work)) == (True, 1, 1), "it counts from one again"


def test_a_suspended_host_is_not_taken_for_silence():
    fleet = fleet_of(A)
    fleet.dispatch(0.0)
    fleet.tick(0.1)
    fleet.tick(1000.0)
    assert not fleet.members[A].silent


def test_a_job_that_two_heartbeats_do_not_list_is_given_again():
    fleet = fleet_of(A, jobs=1)
    (digest,) = digests(fleet.dispatch(0.0), A)
    fleet.handle_heartbeat(A, beat(seen=1), 1.0)
    assert fleet.dispatch(1.0) == []
    fleet.handle_heartbeat(A, beat(seen=1), 2.0)
    assert digests(fleet.dispatch(2.0), A) == [digest]


def test_an_unconfirmed_batch_is_sent_again_under_its_number():
    fleet = fleet_of(A, jobs=1)
    (first,) = fleet.dispatch(0.0)
    fleet.handle_heartbeat(A, beat(seen=0), 1.0)
    fleet.handle_heartbeat(A, beat(seen=0), 2.0)
    (again,) = fleet.dispatch(2.1)
    assert again is first
    fleet.handle_heartbeat(A, beat(seen=1, running=digests([first], A)), 3.0)
    assert numbered(fleet.dispatch(9.0)) == []


@pytest.mark.parametrize(
    ("other", "taker"), [("idle", B), ("busy", None), ("unconfirmed", A), ("held back", A), ("not ready", A)]
)
def test_a_failed_job_goes_to_another_worker_or_waits_for_it_if_it_can_take_jobs_at_all(other, taker):
    fleet = fleet_of(A, jobs=1)
    (digest,) = digests(fleet.dispatch(0.0), A)
    fleet.add_worker(B, 1, "f", 0.0)
    if other != "unconfirmed":
        fleet.handle_heartbeat(B, beat(0 if other == "not ready" else 1), 0.0)
        fleet.members[B].is_held = other == "held back"
    if other == "busy":
        fleet.jobs.offer(work(3, generation=1))
        assert len(digests(fleet.dispatch(0.0), B)) == 2
    fleet.handle_result(A, result(digest, error=failure("boom")), 0.1)
    given = [(send.identity, each.digest) for send in fleet.dispatch(0.2) for each in send.work]
    assert given == ([(taker, digest)] if taker else [])
    assert [each.errors for each in fleet.jobs.failures] == [{A: "boom"}]


def test_the_only_worker_tries_a_failed_job_again_but_not_for_ever():
    fleet = fleet_of(A, jobs=1)
    for attempt in range(3):
        fleet.tick(attempt)  # the third attempt waits for a second
        assert fleet.failure_judge.find_pausing() is None
        (digest,) = digests(fleet.dispatch(attempt), A)
        fleet.handle_result(A, result(digest, error=failure("boom")), attempt)
    assert fleet.failure_judge.find_pausing().errors == {A: "boom"}


@pytest.mark.parametrize(
    ("share", "capacity", "offered", "kinds"),
    [
        (0.25, 4, work(3) + work(5, "evaluate"), ["evaluate", *["score"] * 3]),
        (0.0, 4, work(3) + work(5, "evaluate"), [*["score"] * 3, "evaluate"]),
        (0.25, 8, work(1, "evaluate") + work(5, "collect"), ["evaluate", "collect"]),
    ],
)
def test_evaluations_and_drives_fill_a_quarter_of_the_idle_slots_and_lead_where_they_have_a_share(
    share, capacity, offered, kinds
):
    fleet = Fleet(BEAT, share)
    join(fleet, A, 0.0, capacity)
    fleet.jobs.offer(offered)
    assert [each.job.kind for send in fleet.dispatch(0.0) for each in send.work] == kinds
    fleet.drain_background = True
    assert len(digests(fleet.dispatch(0.1), A)) == 4


def test_a_job_whose_upload_is_on_its_way_is_not_taken_away_unless_it_never_comes():
    fleet = fleet_of(A, jobs=0)
    fleet.jobs.offer(work(2, "collect"))
    fleet.drain_background = True
    first, second = digests(fleet.dispatch(0.0), A)
    fleet.add_worker(B, 1, "f", 0.0)
    fleet.defer_verdict(A, first, 1.0)
    fleet.defer_verdict(A, second, 1.0)
    fleet.handle_heartbeat(A, beat(seen=1, unacked=[first, second]), 1.0)
    fleet.handle_heartbeat(B, beat(), 1.0)
    assert fleet.dispatch(1.0) == []
    assert A in fleet.jobs[first].holders
    late = 1.1 + UPLOAD_SECONDS
    fleet.handle_heartbeat(A, beat(seen=1, unacked=fleet.members[A].leases), late)
    fleet.handle_heartbeat(B, beat(), late)
    assert len(digests(fleet.dispatch(late), B)) == 1
    assert fleet.counts["copied"] == 1
    assert [fleet.handle_result(A, result(each), late)[0] for each in (first, second)] == ["accepted"] * 2


def test_a_paused_fleet_gives_no_jobs_and_still_judges_results():
    fleet = fleet_of(A)
    given = digests(fleet.dispatch(0.0), A)
    fleet.paused = True
    fleet.handle_result(A, result(given[0]), 0.1)
    (send,) = fleet.dispatch(0.1)
    assert not send.work
    assert len(send.verdicts) == 1


@pytest.mark.parametrize(("jobs", "taken"), [(4, 0), (2, 2)])  # the second ones wait for slots that another run uses
def test_a_newcomer_takes_over_what_another_worker_has_waiting(jobs, taken):
    fleet = fleet_of(A, capacity=2, jobs=jobs)
    given = digests(fleet.dispatch(0.0), A)
    fleet.handle_heartbeat(A, replace(beat(2, seen=1, queued=given), taken=taken), 0.1) if taken else None
    join(fleet, B, 0.1)
    sends = fleet.dispatch(0.2)
    assert digests(sends, B) == [given[-1]], "what was given last begins last"
    assert cancelled(sends, A) == [given[-1]]
    assert given[-1] not in fleet.members[A].leases
    assert fleet.counts["recalled"] == 1


def test_what_runs_is_not_recalled():
    fleet = fleet_of(A, capacity=1, jobs=1)
    fleet.dispatch(0.0)
    join(fleet, B, 0.1)
    assert fleet.dispatch(0.2) == []


def tail_of_two(pace_a, pace_b, steps_a):
    """A runs the only job left and has made `steps_a` of a typical 1000 steps; B is idle."""
    fleet = fleet_of(A, B, jobs=3)
    for digest in digests(fleet.dispatch(0.0), B):
        fleet.handle_heartbeat(B, beat(seen=1, running=[digest], rate=pace_b), 0.5)
        fleet.handle_result(B, Result(digest, 1.0, 1000, 0.1, None, None), 1.0)
    first = next(iter(fleet.members[A].leases))
    for digest in list(fleet.members[A].leases)[1:]:
        fleet.handle_result(A, Result(digest, 1.0, 1000, 0.1, None, None), 1.0)
    fleet.handle_heartbeat(A, beat(seen=1, running=[first], rate=pace_a, steps=steps_a), 1.0)
    return fleet, first


def test_a_straggler_on_a_slow_host_is_copied_once_to_a_slot_that_no_other_run_uses_and_the_loser_cancelled():
    fleet, job = tail_of_two(pace_a=10.0, pace_b=1000.0, steps_a=100)
    fleet.handle_heartbeat(B, replace(beat(seen=1), taken=1), 1.0)
    assert digests(fleet.dispatch(1.0), B) == []
    fleet.handle_heartbeat(B, beat(seen=1), 1.0)
    assert digests(fleet.dispatch(1.0), B) == [job]
    assert digests(fleet.dispatch(1.1), B) == []
    assert fleet.handle_result(B, result(job), 2.0)[0] == "accepted"
    assert cancelled(fleet.dispatch(2.0), A) == [job]
    assert fleet.counts["copied"] == 1
    assert fleet.counts["discarded_steps"] == 100


def test_a_job_that_is_nearly_done_is_copied_only_once_its_worker_has_gone_quiet():
    fleet, job = tail_of_two(pace_a=1000.0, pace_b=1000.0, steps_a=100)
    assert digests(fleet.dispatch(1.0), B) == []
    fleet.handle_heartbeat(B, beat(seen=9), 3.1)
    assert digests(fleet.dispatch(3.1), B) == [job]
    assert not fleet.members[A].silent


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_memory_stays_flat_through_a_hundred_thousand_generations_of_churn():
    fleet = fleet_of(A, capacity=4, jobs=0)
    random = np.random.default_rng(1)
    tracemalloc.start()
    held = []
    for generation in range(100_000):
        now, name = generation / 10, f"w/{random.integers(2**32):08x}"
        fleet.jobs.begin_generation(generation)
        fleet.jobs.offer(work(2, generation=generation))
        fleet.add_worker(name, 2, "f", now)
        while fleet.jobs:
            for who, capacity in ((A, 4), (name, 2)):
                fleet.handle_heartbeat(who, beat(capacity, seen=fleet.members[who].number), now)
                for digest in digests(fleet.dispatch(now), who):
                    if random.random() < 0.8:
                        fleet.handle_result(who, result(digest), now)
            now += 0.001
        fleet.handle_departure(name, now)
        fleet.tick(now + 0.06)
        fleet.notes.clear()
        if generation in (10_000, 99_999):  # at the first the event log is full
            held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert held[1] - held[0] < 200_000
    assert set(fleet.members) == {A}


def test_workers_without_a_heartbeat_are_few_and_soon_forgotten():
    fleet = fleet_of(A)
    for number in range(20_000):
        fleet.add_worker(f"stranger/{number:08x}", 2**62, "f", 1.0)
    assert len(fleet.members) == 1 + MAX_UNCONFIRMED
    assert max(member.slots for member in fleet.members.values()) == MAX_SLOTS
    for now in range(1, int(UNCONFIRMED_TIMEOUT) + 3):
        fleet.handle_heartbeat(A, beat(), float(now))
        fleet.tick(float(now))
    assert set(fleet.members) == {A}
    assert [(each.what, each.worker) for each in fleet.notes] == [("joined", A)], (
        "unknown senders cannot fill the log with names"
    )


def test_a_worker_that_confirms_nothing_fills_no_memory_and_hears_its_verdicts_once_it_does():
    fleet = fleet_of(A)
    member, made = fleet.members[A], iter(range(2**32))

    def send_results(count):
        for _ in range(count):
            fleet.handle_result(A, result(next(made).to_bytes(32, "big")), 0.0)
        return [verdict for batch in fleet.dispatch(0.0) for verdict in batch.verdicts]

    sent = [len(send_results(1_000)) for _ in range(3 * MOST_VERDICTS // 1_000)]
    assert sum(sent) == sum(len(batch.verdicts) for batch in member.unconfirmed.values()) == MOST_VERDICTS
    fleet.handle_heartbeat(A, beat(seen=member.number), 0.0)
    assert len(send_results(10)) == 10


def test_a_member_is_forgotten_only_after_a_long_silence():
    fleet = fleet_of(A)
    given = digests(fleet.dispatch(0.0), A)
    for now in range(int(FORGET_AFTER)):
        fleet.tick(float(now))
    assert fleet.members[A].silent
    for now in range(int(FORGET_AFTER), int(FORGET_AFTER) + 10):
        fleet.tick(float(now))
    assert not fleet.members
    assert fleet.handle_result(A, result(given[0]), 100.0)[0] == "accepted", "its results still count"


def known(fleet, name, seconds=0.1, at=0.0):
    """Let a worker return all its jobs, each batch after `seconds`."""
    while given := digests(fleet.dispatch(at), name):
        at += seconds
        for digest in given:
            fleet.handle_result(name, result(digest), at)
    return at


def test_an_idle_worker_gets_an_empty_batch_now_and_then_while_it_is_heard():
    fleet = fleet_of(A, jobs=0)
    heard = []
    for tenth in range(100):
        if tenth % 10 == 0:
            fleet.handle_heartbeat(A, beat(), tenth / 10)
        heard += [(tenth / 10, send.number) for send in fleet.dispatch(tenth / 10)]
    assert {number for _, number in heard} == {0}
    assert 2 <= len(heard) <= 5
    assert max(late - early for (early, _), (late, _) in pairwise(heard)) < SILENT_AFTER * BEAT
    fleet.dispatch(12.0)
    assert fleet.dispatch(20.0) == []


def test_a_large_batch_has_the_time_that_its_link_takes():
    fleet = fleet_of(A, jobs=0)
    fleet.jobs.offer(make_jobs(SPEC, "score", 0, 0, vector_bytes(np.arange(90_000.0)), [1000]))
    parts = fleet.dispatch(0.0)
    for second in range(1, 8):  # 360 kB at 50 kB a second
        fleet.handle_heartbeat(A, beat(seen=second), float(second))
        assert numbered(fleet.dispatch(second + 0.5)) == []
    assert len(parts) > 7
    assert fleet.members[A].host_stats.bandwidth > 35_000


def test_a_batch_that_a_later_one_has_overtaken_is_sent_again_at_once():
    fleet = fleet_of(A, jobs=2)
    (first,) = fleet.dispatch(0.0)
    fleet.jobs.offer(work(3, generation=1))
    done = first.work[0].job.digest
    fleet.handle_result(A, result(done), 0.1)
    (second,) = fleet.dispatch(0.1)
    fleet.handle_heartbeat(A, beat(seen=0, queued=digests([second], A)), 0.2)
    assert [send.number for send in fleet.dispatch(0.2)] == [first.number]


def test_a_worker_that_did_not_hear_the_answer_to_its_hello_is_given_work_at_once():
    fleet = fleet_of(A, jobs=4)
    for _ in range(3):
        for digest in digests(fleet.dispatch(0.0), A)[:1]:
            fleet.handle_result(A, result(digest), 0.0)
    first = fleet.members[A].numbering
    fleet.handle_departure(A, 0.9)
    second = fleet.add_worker(A, 1, "f", 1.0)
    fleet.handle_heartbeat(A, beat(seen=7, numbering=first), 1.1)
    (send,) = [send for send in fleet.dispatch(1.1) if send.work]
    assert (send.numbering, send.number) == (second, 1)
    assert second > first
    fleet.handle_heartbeat(A, beat(seen=1, numbering=second), 1.2)
    assert not fleet.members[A].unconfirmed


def test_a_hello_in_the_name_of_a_live_worker_takes_nothing_from_it_and_a_quiet_one_is_welcomed_anew():
    fleet = fleet_of(A, jobs=4)
    (lost,) = fleet.dispatch(0.0)
    held, numbering = dict(fleet.members[A].leases), fleet.members[A].numbering
    assert fleet.add_worker(A, 1000, "of somebody else", 1.0) == numbering
    assert fleet.members[A].leases == held
    assert (fleet.members[A].slots, fleet.members[A].fingerprint) == (1, "f")
    (again,) = fleet.dispatch(1.1)
    assert (again.numbering, again.number) == (numbering, lost.number), "if it was itself, it may have missed this"
    fleet.add_worker(A, 1, "f", 1.2)
    assert not numbered(fleet.dispatch(1.2)), "which is sent once, however often somebody greets"
    assert fleet.add_worker(A, 1, "f", 2.5) > numbering
    assert not fleet.members[A].leases


def test_a_result_counts_from_the_life_that_was_given_its_job_and_from_nobody_else():
    fleet = fleet_of(A, B, jobs=2)
    sends = fleet.dispatch(0.0)
    (of_a,), (of_b,) = digests(sends, A), digests(sends, B)
    for sender in ("x/0badc0de", "a/0badc0de"):
        assert fleet.handle_result(sender, result(of_a, fitness=1e9), 0.1) == ("refused", None)
    assert fleet.handle_result(B, result(of_a, fitness=1e9), 0.1) == ("refused", None)
    fleet.handle_heartbeat(B, beat(seen=1, running=[of_b], unacked=[of_a]), 0.2)
    assert list(fleet.members[B].leases) == [of_b], "nor is it taken up because somebody shows it"
    assert fleet.handle_result(A, result(of_a), 0.3)[0] == "accepted"
    (verdict,) = [each for send in fleet.dispatch(0.3) if send.identity == B for each in send.verdicts]
    assert (verdict.digest, verdict.verdict) == (of_a, "refused")
    assert fleet.dropped == {"result of an unknown worker": 2, "result of a job that was not given": 1}
    assert fleet.counts["discarded_steps"] == 10, "its steps are not the fleet's"


def test_what_an_earlier_life_gave_counts_after_its_workers_first_heartbeat():
    fleet = Fleet(BEAT)
    fleet.jobs.given_before_until = 1
    fleet.jobs.offer([*work(1), *work(1, generation=2)])
    before, since = fleet.jobs
    assert fleet.handle_result(A, result(before), 0.0)[0] == "refused", "nobody has welcomed it yet"
    fleet.add_worker(A, 1, "f", 0.0)
    assert fleet.handle_result(A, result(before), 0.1)[0] == "refused"
    fleet.handle_heartbeat(A, beat(unacked=[before, since]), 0.2)
    assert list(fleet.members[A].leases) == [before]
    assert fleet.handle_result(A, result(since), 0.3)[0] == "refused", "it cannot have been given"
    assert fleet.handle_result(A, result(before), 0.3)[0] == "accepted"


def test_an_error_of_a_job_that_its_worker_does_not_hold_is_no_failure():
    fleet = fleet_of(A, B, jobs=1)
    (digest,) = digests(fleet.dispatch(0.0), A)
    for name in (B, "x/0badc0de", "y/0badc0de"):
        fleet.handle_result(name, result(digest, error=failure("boom")), 0.1)
    assert not fleet.jobs.failures
    assert digest in fleet.members[A].leases


def test_a_job_with_more_steps_than_it_can_have_goes_to_others_and_its_late_result_still_counts():
    fleet = fleet_of(A, jobs=1)
    (digest,) = digests(fleet.dispatch(0.0), A)
    join(fleet, B, 0.1)
    fleet.handle_heartbeat(A, beat(seen=1, running=[digest], steps=10**12), 1.0)
    fleet.overrun(A, digest)
    sends = fleet.dispatch(1.0)
    assert digests(sends, B) == [digest]
    assert cancelled(sends, A) == [digest]
    fleet.handle_heartbeat(A, beat(seen=2, running=[digest], steps=10**13), 2.0)
    assert not fleet.members[A].leases, "however often it shows it"
    assert not fleet.jobs.failures
    assert fleet.handle_result(A, result(digest), 3.0)[0] == "accepted"


@pytest.mark.parametrize("kind", ["score", "evaluate"])
def test_a_job_that_reports_ever_more_steps_is_copied_after_a_long_time(kind):
    fleet = fleet_of(A, B, jobs=0)
    fleet.drain_background = True
    fleet.jobs.offer(work(2, kind))
    sends = fleet.dispatch(0.0)
    (held,), (other,) = digests(sends, A), digests(sends, B)
    fleet.handle_result(B, result(other), 1.0)
    copied = {}
    for second in range(1, 100):
        fleet.handle_heartbeat(A, beat(seen=1, running=[held], rate=1e6, steps=2 * second), float(second))
        fleet.handle_heartbeat(B, beat(seen=fleet.members[B].number), float(second))
        fleet.tick(float(second))
        for digest in digests(fleet.dispatch(float(second)), B):
            copied.setdefault(digest, second)
    assert copied.keys() == {held}
    assert LONGEST_HELD < copied[held] < LONGEST_HELD + 2 * LONGEST_HELD_TIMES


def test_a_heartbeat_that_confirms_batches_that_were_not_sent_starts_a_new_numbering():
    fleet = fleet_of(A, jobs=2)
    (first,) = fleet.dispatch(0.0)
    given = digests([first], A)
    fleet.handle_heartbeat(A, beat(seen=1000, running=given[:1]), 1.0)
    assert list(fleet.members[A].leases) == given[:1]
    (send,) = numbered(fleet.dispatch(1.0))
    assert send.numbering > first.numbering
    assert (send.number, digests([send], A)) == (1, given[1:])


def test_a_late_heartbeat_from_before_a_hello_confirms_no_later_batch():
    fleet = fleet_of(A, jobs=4)
    first = fleet.members[A].numbering
    fleet.handle_departure(A, 0.9)
    fleet.add_worker(A, 1, "f", 1.0)
    fleet.handle_heartbeat(A, beat(), 1.1)
    given = digests(fleet.dispatch(1.1), A)
    fleet.handle_heartbeat(A, beat(seen=7, numbering=first), 1.2)
    assert list(fleet.members[A].unconfirmed) == [1]
    for now in (1.3, 1.4):
        fleet.handle_heartbeat(A, beat(seen=7, numbering=first), now)
    assert list(fleet.members[A].leases) == given, "they are not missed in what cannot show them"


def test_a_hosts_record_outlives_a_hello_and_its_worker():
    fleet = fleet_of(A, jobs=3)
    known(fleet, A, seconds=0.5)
    host_stats = fleet.members[A].host_stats
    assert host_stats.expected_seconds(2) >= 0.5
    fleet.add_worker(A, 1, "f", 5.0)
    assert fleet.members[A].host_stats is host_stats
    fleet.handle_departure(A, 6.0)
    fleet.tick(7.0)
    fleet.add_worker("a/00000009", 1, "f", 8.0)
    assert fleet.members["a/00000009"].host_stats == host_stats


def test_a_newcomer_beside_a_worker_with_a_record_gets_a_trial_copy():
    fleet = fleet_of(A, jobs=3)
    now = known(fleet, A)
    join(fleet, B, now)
    fleet.jobs.offer(work(6, generation=1))
    held = digests(fleet.dispatch(now), A)
    (copied,) = digests(fleet.dispatch(now), B)
    assert copied == held[-1], "of what begins last where it is"
    for digest in held:
        assert fleet.handle_result(A, result(digest), now + 0.2)[0] == "accepted"
    assert cancelled(fleet.dispatch(now + 0.2), B) == [], "it shows how soon it is, late or not"
    assert fleet.handle_result(B, result(copied), now + 3.0)[0] == "duplicate"
    fleet.dispatch(now + 3.0)
    assert fleet.members[B].host_stats.expected_seconds(1) == pytest.approx(3.0)


def test_a_host_that_is_lost_again_and_again_gets_only_what_it_returns_in_time():
    fleet = fleet_of(A, jobs=3)
    now = known(fleet, A, seconds=1.0)
    for life in range(3):
        name = f"b/{life:08x}"
        join(fleet, name, now)
        fleet.jobs.offer(work(4, generation=life + 1))
        fleet.dispatch(now)
        fleet.dispatch(now)
        fleet.handle_departure(name, now + 1.5)
        fleet.tick(now + 1.6)
        now += 2.0
    join(fleet, "b/00000009", now)
    host_stats = fleet.members["b/00000009"].host_stats
    assert host_stats.losses == 3
    host_stats.record_turnaround(1, 1.0, now)
    assert [host_stats.is_likely_lost(1, age) for age in (0.0, 60.0)] == [True, False]
