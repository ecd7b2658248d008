"""No worker hoards what the run waits for: fleets of dream workers, one slot each, which dream `WIDTH` jobs at once."""

import numpy as np
import pytest

from dreamfleet.common.protocol.messages import TAG_BYTES, Heartbeat, Result, RunningJob
from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.jobs.work import make_work, vector_bytes
from tests.support.samples import HEAD, SPEC

A, B = "a/00000001", "b/00000002"
WIDTH = 32


def jobs(count, kind, generation):
    return make_work(SPEC, kind, generation, 0, vector_bytes(np.arange(4.0) + generation), range(1000, 1000 + count))


def join(fleet, name, now):
    fleet.add_worker(name, 1, "f", now)
    beat(fleet, name, now)


def beat(fleet, name, now):
    """The worker shows all that it was given; its first evaluation runs, else all of its dreams."""
    member = fleet.members[name]
    first = next(iter(member.leases), None)
    runs = [each for each in member.leases if each == first or not fleet.jobs[first].work.job.runs_alone]
    fleet.handle_heartbeat(
        name,
        Heartbeat(
            **HEAD, nonce="n", numbering=member.numbering, seen=member.number, capacity=WIDTH, slots=1, load=0.0,
            steps_per_second=0.0, drawn_by="-", unacked=(),
            running=tuple(RunningJob(each[:TAG_BYTES], 1) for each in runs),
            queued=tuple(each[:TAG_BYTES] for each in member.leases if each not in runs),
        ),
        now,
    )  # fmt: skip


def finish(fleet, name, digest, now):
    assert fleet.handle_result(name, Result(digest, 1.0, 10, 0.1, None, None), now)[0] == "accepted"


def held(fleet):
    return {name: len(member.leases) for name, member in fleet.members.items()}


def measured(**seconds):
    """A fleet whose workers have each returned a dream, so many seconds after it was given."""
    fleet = Fleet(1.0)
    names = {"a": A, "b": B}
    for name in seconds:
        join(fleet, names[name], 0.0)
    fleet.jobs.offer(jobs(len(seconds), "score", 0))
    fleet.dispatch(0.0)
    for name, after in sorted(seconds.items(), key=lambda each: each[1]):
        (digest,) = fleet.members[names[name]].leases
        finish(fleet, names[name], digest, after)
        fleet.dispatch(after)
    return fleet


def wait_for_evaluation(fleet, episodes, now):
    fleet.drain_background = True
    fleet.jobs.offer(jobs(episodes, "evaluate", 0))
    fleet.dispatch(now)


def test_a_worker_holds_two_evaluations_a_slot_however_many_dreams_it_scores_at_once():
    fleet = measured(a=1.0, b=1.0)
    fleet.jobs.offer(jobs(40, "evaluate", 0))
    fleet.dispatch(2.0)
    assert sorted(held(fleet).values()) == [0, 1], "while candidates may come, evaluations take a part of the slots"
    fleet.drain_background = True
    fleet.dispatch(2.1)
    assert held(fleet) == {A: 2, B: 2}


@pytest.mark.parametrize("episodes", [3, 5, 40])
def test_no_slot_idles_while_another_has_evaluations_waiting(episodes):
    fleet, left, now = measured(a=1.0, b=1.0), episodes, 2.0
    wait_for_evaluation(fleet, episodes, now)
    while left > 1:
        assert min(held(fleet).values()) >= 1
        finish(fleet, B, next(iter(fleet.members[B].leases)), now)  # A is stuck in its first one
        left, now = left - 1, now + 0.1
        beat(fleet, A, now)
        beat(fleet, B, now)
        fleet.dispatch(now)
    assert held(fleet)[A] == 1


@pytest.mark.parametrize("slow", [1.0, 20.0], ids=["as fast", "twenty times slower"])
def test_a_slow_worker_takes_part_in_an_evaluation(slow):
    fleet = measured(a=1.0, b=slow)
    wait_for_evaluation(fleet, 40, slow)
    assert held(fleet) == {A: 2, B: 2}


def test_a_newcomer_takes_part_in_an_evaluation_before_it_has_dreamt():
    fleet = measured(a=1.0)
    wait_for_evaluation(fleet, 40, 1.0)
    join(fleet, B, 2.0)
    fleet.dispatch(2.0)
    assert held(fleet) == {A: 2, B: 2}


def test_a_host_that_is_lost_again_and_again_gets_no_evaluation_beside_one_that_stays():
    fleet = measured(a=1.0, b=1.0)
    for _ in range(3):
        fleet.members[B].host_stats.record_loss(2.0)
    wait_for_evaluation(fleet, 40, 1.0)
    assert held(fleet) == {A: 2, B: 0}
    fleet.remove_worker(A)
    fleet.dispatch(2.0)
    assert held(fleet) == {B: 2}


def test_dreams_that_wait_behind_an_evaluation_go_to_an_idle_slot():
    fleet = measured(a=1.0)
    fleet.jobs.offer(jobs(1, "evaluate", 0))
    fleet.dispatch(1.0)
    fleet.jobs.offer(jobs(8, "score", 1))
    fleet.dispatch(1.1)
    beat(fleet, A, 1.2)
    assert held(fleet) == {A: 9}
    join(fleet, B, 1.3)
    fleet.dispatch(1.3)
    assert held(fleet) == {A: 1, B: 8}
