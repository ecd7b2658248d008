"""When a worker says hello again, drains and leaves, for any order of events."""

import math

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

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
IDLE = WorkerLoad(idle=True, awaits_verdict=False, uploading=False)


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
    assert not member.find_end(30.9, busy=True)
    assert "" != expired.find_end(1.1, busy=False) != member.find_end(1.1, busy=False) != ""
    assert "--drain-timeout" in member.find_end(31.1, busy=True)


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


class AnyOrder(RuleBasedStateMachine):
    """A worker among coordinators that come and go, compared with a simple model of what happened."""

    nonces = st.sampled_from(["first", "second", "third"])
    hands = st.builds(WorkerLoad, idle=st.booleans(), awaits_verdict=st.booleans(), uploading=st.booleans())

    def __init__(self):
        super().__init__()
        self.now = 0.0
        terms = {"lifetime": 200.0, "drain_timeout": 30.0, "leaves_with_run": True, "coordinator_timeout": TIMEOUT}
        self.terms, self.member = LeaveConditions(**terms), joined(visible=False, **terms)
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
        timeout = SILENCE + (UPLOAD_GRACE if hands.uploading else 0)
        forgotten = self.now - self.spoke > timeout and (hands.idle or hands.awaits_verdict)
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
        self.now += SILENCE / 2
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
