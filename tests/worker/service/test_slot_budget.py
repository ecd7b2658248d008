"""How runs share a worker's slots, by a simulation in virtual time."""

import math
import random

import pytest

from dreamfleet.worker.service.slot_budget import QUANTUM, RECENT, TIMEOUT, SlotBudget


class Simulated:
    """Runs whose jobs take known seconds; each has always jobs waiting unless it idles.

    With `candidates`, a run has its generation's jobs alone, and the next one's once the last of them has ended.
    """

    def __init__(self, slots, candidates=math.inf, **runs):
        self.now = self.idled = 0.0
        self.budget, self.slots, self.candidates = SlotBudget(slots), slots, candidates
        self.running, self.idle = [], set()  # (end, run, seconds) of jobs; names of runs
        self.used, self.left = dict.fromkeys(runs, 0.0), dict.fromkeys(runs, candidates)
        self.keys = {name: number for number, name in enumerate(runs)}
        self.seconds = {name: seconds for name, (_, seconds) in runs.items()}
        for name, (share, _) in runs.items():
            self.budget.join(self.keys[name], share, self.now)

    def fill(self):
        order = random.Random(self.now).sample(list(self.keys), len(self.keys))
        for name in order:
            if not self.left[name] and not self.held(name):
                self.budget.settle(self.keys[name], 0, 0, self.now, has_jobs=False)
                self.left[name] = self.candidates
            wanted = 0 if name in self.idle else min(self.left[name], self.slots)
            self.budget.settle(self.keys[name], self.held(name), wanted, self.now, has_jobs=wanted > 0)
        for name in order:
            while self.left[name] and name not in self.idle and self.budget.take(self.keys[name], self.now):
                self.left[name] -= 1
                seconds = self.seconds[name]() if callable(self.seconds[name]) else self.seconds[name]
                self.running.append((self.now + seconds, name, seconds))

    def held(self, name):
        return sum(each[1] == name for each in self.running)

    def run(self, seconds):
        until = self.now + seconds
        while self.now < until:
            self.fill()
            if not self.running:
                return
            self.running.sort()
            end, name, seconds = self.running.pop(0)
            self.idled += (self.slots - len(self.running) - 1) * (end - self.now)
            self.now = end
            self.used[name] += seconds


@pytest.mark.parametrize(("slots", "long"), [(1, 0.5), (2, 0.5), (16, 0.5), (1, 10)])
@pytest.mark.parametrize("share", [1.0, 3.0, 0.2])
def test_two_busy_runs_get_slot_time_by_their_shares_whatever_their_jobs_take(slots, share, long):
    two = Simulated(slots, one=(1.0, long), other=(share, 0.5))
    two.run(max(400 * (1 + 2 * long) / slots, 100))
    assert two.used["other"] / two.used["one"] == pytest.approx(share, rel=0.05)
    assert two.idled == 0


def about_a_second():
    """Draws how long jobs take."""
    rng = random.Random(1)
    return lambda: rng.uniform(0.5, 1.5)


@pytest.mark.parametrize("candidates", [16, 32, 64])
def test_gaps_between_generations_cost_no_share(candidates):
    seconds = about_a_second()
    two = Simulated(4, candidates, one=(1.0, seconds), other=(3.0, seconds))
    two.run(3000)
    assert two.used["other"] / two.used["one"] == pytest.approx(3, rel=0.1)


@pytest.mark.parametrize("slots", [1, 4])
def test_the_least_share_is_a_run_in_the_background_that_never_starves(slots):
    two = Simulated(slots, one=(1.0, 0.5), background=(0.01, 0.5))
    two.run(2000)
    assert two.used["background"] / two.used["one"] == pytest.approx(0.01, rel=0.05)
    two.idle.add("one")
    before = two.used["background"]
    two.run(100)
    assert two.used["background"] - before > 99 * slots


def test_a_run_in_the_background_fills_the_gaps_between_generations():
    seconds = about_a_second()
    alone = Simulated(4, 64, one=(1.0, seconds))
    two = Simulated(4, 64, one=(1.0, seconds), background=(0.01, seconds))
    for each in (alone, two):
        each.run(1000)
    assert two.used["one"] > 0.95 * alone.used["one"]
    assert two.used["background"] > 0.04 * 4 * 1000


def test_runs_that_work_now_and_then_save_no_credit_for_a_burst():
    names = [f"r{number}" for number in range(16)]
    many = Simulated(1, victim=(1.0, 0.25), **dict.fromkeys(names, (1.0, 0.01)))
    for _ in range(40):  # each scores for a moment, every 1.5 seconds
        many.idle.clear()
        many.run(0.01 * len(names))
        many.idle.update(names)
        many.run(1.5 - 0.01 * len(names))
    many.idle.clear()
    before = many.used["victim"]
    many.run(20 * (1 + len(names)) * 0.25)
    assert many.used["victim"] - before > 10 * 0.25


def test_a_run_that_joins_late_owes_nothing_and_is_owed_nothing():
    budget = SlotBudget(1)
    budget.join(0, 1.0, 0.0)
    budget.settle(0, 1, 0, 0.0, has_jobs=True)
    budget.settle(0, 0, 0, 1000.0, has_jobs=False)
    budget.join(1, 1.0, 1000.0)
    budget.settle(1, 0, 1, 1000.0, has_jobs=True)
    assert budget.take(1, 1000.0)
    budget.settle(0, 0, 1, 1001.0, has_jobs=True)
    budget.settle(1, 0, 1, 1001.0, has_jobs=True)
    assert budget.take(0, 1001.0), "it pays for what it used when it was alone"


def two_runs_of_one_slot():
    """A budget of two runs that wait for its one slot, of which the first takes it."""
    budget = SlotBudget(1)
    for run in (0, 1):
        budget.join(run, 1.0, 0.0)
        budget.settle(run, 0, 1, 0.0, has_jobs=True)
    assert budget.take(0, 0.0)
    return budget


def test_short_jobs_alternate_only_once_a_run_is_ahead_by_a_quantum():
    budget = two_runs_of_one_slot()
    assert budget.goes_on(0, QUANTUM / 2)
    assert not budget.goes_on(0, QUANTUM * 1.1)
    budget.settle(0, 0, 1, QUANTUM * 1.1, has_jobs=True)
    assert not budget.take(0, QUANTUM * 1.1)
    assert budget.next_runs(0, QUANTUM * 1.1) == [1]


def test_a_run_that_does_not_take_its_turn_is_passed_over():
    budget = two_runs_of_one_slot()
    budget.settle(0, 0, 1, 5.0, has_jobs=True)
    assert not budget.take(0, 5.0)
    assert budget.take(0, 5.0 + 1.1 * TIMEOUT)
    budget.settle(0, 0, 1, 9.0, has_jobs=True)
    assert budget.take(0, 9.0), "no slot waits for it again"
    budget.settle(1, 0, 1, 9.5, has_jobs=True)
    budget.settle(0, 0, 1, 10.0, has_jobs=True)
    assert not budget.take(0, 10.0), "it is back"


def test_what_a_run_can_count_on_is_its_part_and_what_the_others_leave():
    budget = SlotBudget(8)
    budget.join(0, 1.0, 0.0)
    assert budget.allowance(0, 0.0) == 8
    budget.join(1, 3.0, 0.0)
    assert [budget.allowance(run, 0.0) for run in (0, 1)] == [8, 8], "neither had a job"
    budget.settle(1, 8, 4, 1.0, has_jobs=True)
    assert budget.allowance(0, 1.0) == 2
    budget.settle(1, 1, 0, 2.0, has_jobs=False)
    assert budget.allowance(0, 2.0) == 7
    budget.settle(1, 0, 0, 3.0, has_jobs=False)
    assert budget.allowance(0, 3.0 + 2 * RECENT) == 8
    budget.leave(1, 9.0)
    assert budget.allowance(0, 9.0) == 8
    single = SlotBudget(1)
    for run in range(5):
        single.join(run, 1.0, 0.0)
        single.settle(run, 0, 1, 0.0, has_jobs=True)
    assert {single.allowance(run, 0.0) for run in range(5)} == {1}, "each counts on the one slot"


def test_what_a_run_could_use_at_once_is_what_the_others_neither_hold_nor_wait_for():
    budget = SlotBudget(4)
    for run in (0, 1):
        budget.join(run, 1.0, 0.0)
    assert budget.usable(0) == 4
    budget.settle(1, 2, 1, 0.0, has_jobs=True)
    assert budget.usable(0) == 1
    budget.settle(0, 2, 0, 0.0, has_jobs=True)
    assert budget.usable(0) == 2, "what it holds it can use"
