"""No worker hoards what the run waits for: fleets of dream workers, one slot each, which dream `WIDTH` jobs at once.

Tests member.py, speculative_execution.py and worker_selection.py.
"""

import pytest
from msgspec.structs import replace

from dreamfleet.coordinator.dispatch.fleet import Fleet
from tests.support import dispatched
from tests.support.dispatched import A, B, result, work

WIDTH = 32


def join(fleet, name, now):
    fleet.add_worker(name, 1, "f", now)
    beat(fleet, name, now)


def beat(fleet, name, now):
    """The worker shows all that it was given; its first evaluation runs, else all of its dreams."""
    member = fleet.members[name]
    first = next(iter(member.leases), None)
    runs = [each for each in member.leases if each == first or not fleet.jobs[first].work.job.is_background]
    waits = [each for each in member.leases if each not in runs]
    shown = dispatched.beat(WIDTH, member.number, member.numbering, queued=waits, running=runs, steps=1)
    fleet.handle_heartbeat(name, replace(shown, slots=1), now)


def finish(fleet, name, digest, now):
    assert fleet.handle_result(name, result(digest), now)[0] == "accepted"


def held(fleet):
    return {name: len(member.leases) for name, member in fleet.members.items()}


def measured(*seconds):
    """A fleet whose workers have each returned a dream, so many seconds after it was given."""
    fleet, names = Fleet(1.0), (A, B)[: len(seconds)]
    for name in names:
        join(fleet, name, 0.0)
    fleet.jobs.offer(work(len(names)))
    fleet.dispatch(0.0)
    for after, name in sorted(zip(seconds, names, strict=True)):
        (digest,) = fleet.members[name].leases
        finish(fleet, name, digest, after)
        fleet.dispatch(after)
    return fleet


def wait_for_evaluation(fleet, episodes, now):
    fleet.drain_background = True
    fleet.jobs.offer(work(episodes, "evaluate"))
    fleet.dispatch(now)


def test_a_worker_holds_two_evaluations_a_slot_however_many_dreams_it_scores_at_once():
    fleet = measured(1.0, 1.0)
    fleet.jobs.offer(work(40, "evaluate"))
    fleet.dispatch(2.0)
    assert sorted(held(fleet).values()) == [0, 1], "while candidates may come, evaluations take a part of the slots"
    fleet.drain_background = True
    fleet.dispatch(2.1)
    assert held(fleet) == {A: 2, B: 2}


@pytest.mark.parametrize("episodes", [3, 5, 40])
def test_no_slot_idles_while_another_has_evaluations_waiting(episodes):
    fleet, left, now = measured(1.0, 1.0), episodes, 2.0
    wait_for_evaluation(fleet, episodes, now)
    while left > 1:
        assert min(held(fleet).values()) >= 1
        finish(fleet, B, next(iter(fleet.members[B].leases)), now)  # A is stuck in its first one
        left, now = left - 1, now + 0.1
        beat(fleet, A, now)
        beat(fleet, B, now)
        fleet.dispatch(now)
    assert held(fleet)[A] == 1


def test_a_slow_worker_takes_part_in_an_evaluation():
    fleet = measured(1.0, 20.0)
    wait_for_evaluation(fleet, 40, 20.0)
    assert held(fleet) == {A: 2, B: 2}


def test_a_newcomer_takes_part_in_an_evaluation_before_it_has_dreamt():
    fleet = measured(1.0)
    wait_for_evaluation(fleet, 40, 1.0)
    join(fleet, B, 2.0)
    fleet.dispatch(2.0)
    assert held(fleet) == {A: 2, B: 2}


def test_a_host_that_is_lost_again_and_again_gets_no_evaluation_beside_one_that_stays():
    fleet = measured(1.0, 1.0)
    for _ in range(3):
        fleet.members[B].host_stats.record_loss(2.0)
    wait_for_evaluation(fleet, 40, 1.0)
    assert held(fleet) == {A: 2, B: 0}
    fleet.remove_worker(A)
    fleet.dispatch(2.0)
    assert held(fleet) == {B: 2}


def test_dreams_that_wait_behind_an_evaluation_go_to_an_idle_slot():
    fleet = measured(1.0)
    fleet.jobs.offer(work(1, "evaluate"))
    fleet.dispatch(1.0)
    fleet.jobs.offer(work(8, "score", 1))
    fleet.dispatch(1.1)
    beat(fleet, A, 1.2)
    assert held(fleet) == {A: 9}
    join(fleet, B, 1.3)
    fleet.dispatch(1.3)
    assert held(fleet) == {A: 1, B: 8}
