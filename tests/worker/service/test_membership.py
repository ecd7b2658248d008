"""When a worker says hello again, drains and leaves, for any order of events."""

import math

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from dreamfleet.worker.service.membership import (
    FIRST_DELAY,
    MAX_DELAY,
    NEXT_RUN_AFTER,
    NEXT_RUN_PATIENCE,
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
PATIENCE = SILENT_BEATS * BEAT
TIMEOUT = 60.0  # of a coordinator out of sight
IDLE = WorkerLoad(idle=True, awaits_verdict=False, uploading=False)
BUSY = WorkerLoad(idle=False, awaits_verdict=False, uploading=False)
OWED = WorkerLoad(idle=False, awaits_verdict=True, uploading=False)
UPLOADING = WorkerLoad(idle=True, awaits_verdict=True, uploading=True)


def joined(visible=True, **terms):
    """A member at time 0, in the first life of its coordinator."""
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


@pytest.mark.parametrize(("hands", "after"), [(IDLE, PATIENCE), (OWED, PATIENCE), (UPLOADING, PATIENCE + UPLOAD_GRACE)])
def test_silence_of_a_coordinator_that_owes_an_answer_makes_it_say_hello(hands, after):
    member = joined()
    assert not member.must_rejoin(after, hands)
    assert member.must_rejoin(after + 0.1, hands)


def test_it_says_hello_when_the_coordinator_is_back_in_sight():
    member = joined()
    member.remove_coordinator("first", 1.0)
    assert not member.must_rejoin(1.0, BUSY)
    assert member.add_coordinator("first")
    assert not member.add_coordinator("first")
    assert member.must_rejoin(1.0, BUSY)
    member.remove_coordinator("first", 1.0)
    assert not member.add_coordinator("second"), "another life"


def test_it_looks_for_its_run_in_intervals_while_no_coordinator_is_in_sight():
    member = joined()
    assert not member.start_search_if_due(1e6), "one is in sight"
    member.remove_coordinator("first", 1e6)
    assert not member.start_search_if_due(1e6 + SEARCH_INTERVAL - 0.1)
    assert member.start_search_if_due(1e6 + SEARCH_INTERVAL)
    assert not member.start_search_if_due(1e6 + SEARCH_INTERVAL)
    assert member.start_search_if_due(1e6 + 2 * SEARCH_INTERVAL)


def test_stopped_once_it_drains_until_all_is_delivered():
    member = joined(drain_timeout=30.0)
    assert not member.start_draining_if_due(1.0)
    member.stop()
    assert member.start_draining_if_due(1.0)
    assert not member.start_draining_if_due(1.1), "it begins once"
    assert (member.is_leaving(1.1), member.draining) == (True, True)
    assert not member.find_end(30.9, busy=True)
    assert member.find_end(1.1, busy=False)
    assert member.find_end(31.1, busy=True), "but not for ever"


def test_it_drains_at_the_end_of_its_lifetime_which_begins_before_any_run():
    member = Membership(LeaveConditions(lifetime=10.0), now=0.0)
    assert not member.is_leaving(9.9)
    assert member.is_leaving(10.0)
    member.join("first", BEAT, now=9.0)
    assert not member.start_draining_if_due(9.9)
    assert member.start_draining_if_due(10.0)


def test_it_drains_once_its_join_file_ends_by_the_wall_clock_however_little_time_it_was_awake():
    left = [1.0]
    member = joined(is_expired=lambda: left[0] <= 0)
    assert not member.start_draining_if_due(1.0)
    left[0] = -1.0
    assert member.start_draining_if_due(1.0)


@pytest.mark.parametrize("seen", [True, False])
def test_a_worker_that_leaves_with_its_run_gives_up_a_coordinator_only_after_long_patience(seen):
    leaves = joined(visible=seen, leaves_with_run=True, coordinator_timeout=TIMEOUT)
    stays = joined(visible=seen, coordinator_timeout=TIMEOUT)
    since = 1e6 if seen else 0.0
    for member in (leaves, stays):
        if seen:
            assert not member.find_end(1e6, busy=False)
            member.remove_coordinator("first", 1e6)
        member.remove_coordinator("never seen", since + 1.0)  # losing a token twice does not restart the clock
        assert not member.find_end(since + TIMEOUT, busy=True)
        assert not member.find_end(since + TIMEOUT, busy=False), "it waits for a restart although it has nothing"
        assert not member.gives_up(since + TIMEOUT)
    assert leaves.find_end(since + TIMEOUT + 0.1, busy=True)
    assert leaves.gives_up(since + TIMEOUT + 0.1)
    assert not stays.find_end(math.inf, busy=False)
    leaves.add_coordinator("second")
    assert not leaves.find_end(math.inf, busy=True)


def test_a_worker_of_any_run_goes_on_soon_but_not_at_once_with_results():
    member = joined(serves_any=True)
    member.remove_coordinator("first", 0.0)
    assert not member.find_end(NEXT_RUN_AFTER, busy=False)
    assert member.find_end(NEXT_RUN_AFTER + 0.1, busy=False)
    assert not member.find_end(NEXT_RUN_PATIENCE, busy=True)
    assert member.find_end(NEXT_RUN_PATIENCE + 0.1, busy=True)
    assert not member.gives_up(math.inf), "that is no failure"


def test_a_drained_worker_names_why():
    stopped, expired = joined(drain_timeout=30.0), joined(lifetime=1.0)
    stopped.stop()
    for member in (stopped, expired):
        assert member.start_draining_if_due(1.0)
    assert stopped.find_end(2.0, busy=False) != expired.find_end(2.0, busy=False)
    assert "--drain-timeout" in stopped.find_end(32.0, busy=True)
    assert expired.find_end(2.0, busy=False)


def test_a_run_that_refused_is_asked_again_with_growing_pauses():
    refusals, now, pauses = RefusalBackoff(), 0.0, []
    for _ in range(10):
        pauses.append(refusals.add("night", now))
        assert refusals.refusing_runs(now + pauses[-1] - 0.1) == {"night"}
        now += pauses[-1]
        assert refusals.refusing_runs(now) == set()
    assert pauses[:3] == [FIRST_DELAY, 2 * FIRST_DELAY, 4 * FIRST_DELAY]
    assert pauses[-1] == MAX_DELAY


def test_each_run_has_its_own_pause():
    refusals = RefusalBackoff()
    refusals.add("night", 0.0)
    refusals.add("night", FIRST_DELAY)
    refusals.add("day", FIRST_DELAY)
    assert refusals.refusing_runs(2 * FIRST_DELAY - 0.1) == {"night", "day"}
    assert refusals.refusing_runs(2 * FIRST_DELAY + 0.1) == {"night"}


def test_a_reason_is_news_once_and_again_after_another_one():
    refusals = RefusalBackoff()
    assert [refusals.is_news("night", why) for why in "aabba"] == [True, False, True, False, True]
    assert refusals.is_news("day", "a")


def test_a_run_that_accepted_the_worker_has_the_shortest_pause_again():
    refusals = RefusalBackoff(*SINGLE_RUN_DELAYS)
    assert [refusals.add("night", 0.0) for _ in range(8)] == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0]
    refusals.forget("night")
    assert refusals.refusing_runs(0.0) == set()
    assert refusals.add("night", 0.0) == 1.0


class AnyOrder(RuleBasedStateMachine):
    """A worker among coordinators that come and go, compared with a simple model of what happened."""

    nonces = st.sampled_from(["first", "second", "third"])
    hands = st.builds(WorkerLoad, idle=st.booleans(), awaits_verdict=st.booleans(), uploading=st.booleans())

    def __init__(self):
        super().__init__()
        self.now = 0.0
        self.terms = LeaveConditions(
            lifetime=200.0, drain_timeout=30.0, leaves_with_run=True, coordinator_timeout=TIMEOUT
        )
        self.member = joined(
            visible=False, lifetime=200.0, drain_timeout=30.0, leaves_with_run=True, coordinator_timeout=TIMEOUT
        )
        self.seen, self.of, self.doubt = set(), "first", False
        self.spoke = self.alone = self.allowed = 0.0
        self.stops = self.drains = 0

    @rule(nonce=nonces)
    def a_token_appears(self, nonce):
        self.member.add_coordinator(nonce)
        self.seen.add(nonce)

    @rule(nonce=nonces)
    def a_token_vanishes(self, nonce):
        if self.seen == {nonce}:
            self.alone = self.now
        self.member.remove_coordinator(nonce, self.now)
        self.seen.discard(nonce)
        self.doubt |= nonce == self.of

    @rule()
    def the_coordinator_speaks(self):
        self.member.note_activity(self.now)
        self.spoke = self.now

    @rule(seconds=st.floats(0.01, 20.0))
    def time_passes(self, seconds):
        self.now += seconds

    @rule()
    def it_is_stopped(self):
        self.member.stop()
        self.stops += 1

    @rule(hands=hands, answers=st.booleans(), pause=st.floats(0.1, 2.0))
    def it_asks_if_it_must(self, hands, answers, pause):
        must = self.member.must_rejoin(self.now, hands)
        patience = PATIENCE + (UPLOAD_GRACE if hands.uploading else 0)
        forgotten = self.now - self.spoke > patience and (hands.idle or hands.awaits_verdict)
        reason = self.doubt or self.of not in self.seen or forgotten
        assert must == (bool(self.seen) and self.now >= self.allowed and reason)
        if not must:
            return
        self.member.note_hello_sent(self.now, pause)
        self.allowed = self.now + pause
        if answers:
            self.of, self.doubt, self.spoke = min(self.seen), False, self.now
            self.member.rejoin(self.of, self.now)
        self.now += 1e-9
        assert not self.member.must_rejoin(self.now, hands), "it never asks without a pause"

    @rule()
    def it_drains_if_it_must(self):
        if self.member.start_draining_if_due(self.now):
            self.drains += 1
            self.drain_until = self.now + self.terms.drain_timeout

    @rule()
    def a_coordinator_that_stays_knows_it_in_the_end(self):
        """From any state: one coordinator is there, answers and speaks; nothing is then left to ask."""
        for nonce in list(self.seen - {"third"}):
            self.a_token_vanishes(nonce)
        self.a_token_appears("third")
        self.now = max(self.now, self.allowed)
        self.it_asks_if_it_must(IDLE, answers=True, pause=1.0)
        self.the_coordinator_speaks()
        self.now += PATIENCE / 2
        assert not self.member.must_rejoin(self.now, IDLE)

    @invariant()
    def it_leaves_for_a_reason_and_then_only(self):
        assert self.member.is_leaving(self.now) == (self.stops > 0 or self.now >= self.terms.lifetime)
        assert self.drains <= 1
        for busy in (True, False):
            is_over = bool(self.member.find_end(self.now, busy))
            if self.stops > 1:
                assert is_over
            elif self.drains:
                is_alone = self.stops and not self.seen and self.now - self.alone > SEARCH_INTERVAL
                assert is_over == bool(not busy or self.now > self.drain_until or is_alone)
            else:
                given_up = not self.seen and self.now - self.alone > TIMEOUT
                assert is_over == (given_up and not self.member.is_leaving(self.now))


TestAnyOrder = AnyOrder.TestCase
TestAnyOrder.settings = settings(max_examples=100, stateful_step_count=50)
