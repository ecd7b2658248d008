"""A few hundred schedules; `make simulate` plays a hundred thousand.

Tests coordinator/dispatch/leases.py, coordinator/dispatch/member.py, coordinator/dispatch/packing.py,
coordinator/dispatch/pending_jobs.py, coordinator/dispatch/speculative_execution.py, coordinator/run/worker_protocol.py,
worker/service/backlog.py, worker/service/membership.py and worker/service/outbox.py.
"""

from dataclasses import replace

import pytest

from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.jobs import generation
from tests.simulation.campaign import run, shrunk
from tests.simulation.mutants import FOUND, MUTANTS
from tests.simulation.schedule import KINDS, Schedule, Shape, draw
from tests.simulation.shrink import Shrinker
from tests.simulation.truth import STEPS
from tests.simulation.world import play


def assert_no_violation(tally):
    assert not tally.failed, "\n".join(
        f"{outcome.violation}\n  python -m tests.simulation --replay '{outcome.schedule.to_json()}'\n{outcome.trace}"
        for outcome in shrunk(tally, seed=1)
    )
    assert tally.faults.keys() == KINDS.keys(), "every kind of fault has found something to disturb"


@pytest.mark.slow
def test_no_schedule_of_faults_breaks_a_rule():
    assert_no_violation(run(schedules=200, seed=1, jobs=1))


@pytest.mark.slow
def test_no_schedule_breaks_a_rule_where_generations_are_made_in_parts(monkeypatch):
    monkeypatch.setattr(generation, "PART_JOBS", 3)
    assert_no_violation(run(schedules=200, seed=2, jobs=1))


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_no_schedule_of_a_hundred_thousand_breaks_a_rule():
    assert_no_violation(run(schedules=100_000, seed=1, jobs=2))


@pytest.mark.parametrize("schedule", FOUND, ids=lambda schedule: schedule.name)
def test_what_once_broke_a_rule_does_so_no_more(schedule):
    assert play(schedule).violation is None


@pytest.mark.long
@pytest.mark.parametrize("name", MUTANTS)
def test_a_rule_that_is_forgotten_is_missed(name):
    found = MUTANTS[name].find(seed=1, most=300)
    assert found is not None, "no schedule shows that this rule is gone"
    broken = [each for each in ("TypeError", "AttributeError") if each in str(found[1].violation)]
    assert not broken, "the mutant itself is broken"


def test_a_schedule_is_played_the_same_every_time_and_breaks_no_rule():
    for number in range(20):
        first, again = play(draw(1, number)), play(draw(1, number))
        assert (first.now, first.events, first.scored) == (again.now, again.events, again.scored)
        assert first.violation is None


@pytest.mark.slow
def test_a_fleet_that_nobody_disturbs_wastes_next_to_nothing():
    for number in range(100):
        calm = replace(draw(1, number), faults=())
        outcome = play(replace(calm, shape=replace(calm.shape, ends=True, verify=0.0, failing=0.0)))
        assert outcome.violation is None
        tried = STEPS * (calm.shape.workers - 1)  # a copy of a job each, for it shows how soon a newcomer is
        assert outcome.scored <= 1.01 * outcome.counted + tried


@pytest.mark.slow
def test_what_fails_is_cut_down_to_the_faults_that_it_takes():
    mutant = MUTANTS["fleet_keeps_the_leases_of_a_worker_that_joins_again"]
    number, failed = mutant.find(seed=1, most=600)
    with mutant.planted():
        small = Shrinker(failed).shrink()
        again = play(Schedule.from_json(small.schedule.to_json()))
    assert len(small.schedule.faults) <= 3 < len(draw(1, number).faults)
    assert str(again.violation) == str(small.violation)
    assert play(small.schedule).violation is None, "it is the mutant that it shows"


def test_what_the_product_raises_is_a_violation_with_its_place(monkeypatch):
    monkeypatch.setattr(Fleet, "tick", lambda self, now: {}["nothing"])
    outcome = play(Schedule(Shape(), ()))
    assert outcome.violation.rule == "raised"
    assert "in advance" in outcome.trace or "in tick" in outcome.trace
