"""How the jobs of a backlog are divided among a worker's slots."""

import queue

import numpy as np
import pytest

from dreamfleet import DreamfleetError, Scorer
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.scoring.drive_count import ENOUGH
from dreamfleet.worker.service import slot_pool
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.child import ScorerArguments
from dreamfleet.worker.service.slot_budget import SharedSlots
from dreamfleet.worker.service.slot_pool import BATCH_INTERVAL, SlotPool
from tests.support import rough_tasks, tasks
from tests.support.processes import DEADLINE
from tests.support.samples import VECTOR, batch, job

SIDE_BY_SIDE = f"{tasks.MODULE}:SideBySide"


class Pool:
    def __init__(self, task, bundle, slots, torch_device=""):
        self.spec = TaskSpec(task=task, bundle=bundle.sha256, horizon=100, patience=0)
        self.events = queue.SimpleQueue()
        share = SharedSlots(slots).open(1.0, lambda: None)
        self.slots = SlotPool(share, ScorerArguments(self.spec, bundle.path, (task,), torch_device), self.events, 0)
        self.backlog = Backlog(self.spec)
        while self.slots.ready_count < slots:
            self.take()

    def take(self):
        return self.slots.handle(self.events.get(timeout=DEADLINE)[1])

    def add(self, jobs):
        self.backlog.add_batch(batch(self.backlog.seen + 1, jobs))

    def score(self, count):
        """So many jobs, their fitness by digest, and the sizes of the groups in the order in which they began."""
        jobs = tuple(job(number, spec=self.spec) for number in range(count))
        self.add(jobs)
        results, sizes, begun = {}, [], set()
        while len(results) < count:
            self.slots.fill(self.backlog, 0)
            for slot in self.slots._slots:
                group = tuple(each.digest for each in slot.running)
                if group and group not in begun:
                    begun.add(group)
                    sizes.append(len(group))
            results |= {each.digest: each.fitness for each in self.take()}
        return jobs, results, sizes


@pytest.fixture
def pool(random_bundle):
    made = []

    def make(task, slots=2, **more):
        made.append(Pool(task, random_bundle, slots, **more))
        return made[-1]

    yield make
    for each in made:
        each.slots.stop()


def test_groups_of_episodes_that_are_driven_side_by_side_shrink_as_the_jobs_run_out(pool, random_bundle):
    fleet = pool(SIDE_BY_SIDE)
    assert (fleet.slots.side_by_side, fleet.slots.capacity) == (4, 8)
    jobs, results, sizes = fleet.score(11)
    assert sizes[:2] == [4, 4]
    assert sorted(sizes[2:], reverse=True) in ([2, 1], [1, 1, 1])
    alone = Scorer(fleet.spec, random_bundle)
    parameters = np.frombuffer(VECTOR, dtype="<f4")
    assert results == {each.digest: alone.score("score", parameters, each.seeds[0]).fitness for each in jobs}


def test_a_slot_finds_from_its_drives_how_many_it_should_do_side_by_side(pool, monkeypatch):
    fleet = pool(SIDE_BY_SIDE, slots=1)
    add = fleet.slots._drive_count.add
    # Two take the least here, whatever this host takes.
    monkeypatch.setattr(
        fleet.slots._drive_count, "add", lambda drives, steps, _: add(drives, steps, steps * abs(drives - 2))
    )
    sizes = fleet.score(60)[2]
    assert set(sizes[: 4 * ENOUGH]) == {4, 2, 1}
    assert sizes[-8:-1] == [2] * 7
    assert (fleet.slots.side_by_side, fleet.slots.capacity) == (2, 2)


@pytest.mark.parametrize("task", [f"{rough_tasks.MODULE}:OnlyOne", f"{tasks.MODULE}:OneByOne"])
def test_without_a_second_environment_or_such_a_policy_jobs_are_scored_one_by_one(pool, task):
    fleet = pool(task)
    assert (fleet.slots.side_by_side, fleet.slots.capacity) == (1, 2)
    assert fleet.score(5)[2] == [1] * 5


def test_on_a_torch_device_a_part_of_a_batch_waits_for_the_rest_that_arrives_but_not_for_ever(pool, monkeypatch):
    fleet, now, brief = pool(f"{tasks.MODULE}:OnTorch", slots=1, torch_device="cpu"), [0.0], 0.9 * BATCH_INTERVAL
    monkeypatch.setattr(slot_pool, "monotonic", lambda: now[0])
    monkeypatch.setattr(slot_pool, "LONGEST_WAIT", 3 * BATCH_INTERVAL)
    assert fleet.slots.capacity == 8
    (slot,) = fleet.slots._slots

    def fill(seconds, *numbers):
        """Whether jobs wait, and how many are scored, after these jobs arrived so much later."""
        now[0] += seconds
        fleet.add(job(number, spec=fleet.spec) for number in numbers)
        fleet.slots.fill(fleet.backlog, 0)
        return fleet.slots.awaits_jobs, len(slot.running)

    def finish():
        while slot.running:
            fleet.take()
        fill(0.0)

    assert [fill(brief, *part) for part in ((0, 1, 2), (3, 4, 5), ())] == [(True, 0)] * 3
    assert fill(0.2 * BATCH_INTERVAL) == (False, 6), "no more came meanwhile"
    finish()
    assert [fill(brief, number) for number in range(6, 11)] == [(True, 0)] * 4 + [(False, 5)], "they trickle in"
    finish()
    assert fill(brief, *range(11, 21)) == (False, 8)
    assert len(slot.waiting) == 2


def test_without_a_torch_device_no_part_of_a_batch_waits(pool):
    fleet = pool(f"{tasks.MODULE}:OnTorch", slots=1)
    assert fleet.slots.capacity == 256
    assert fleet.score(3)[2] == [3]


@pytest.mark.add_on
def test_a_torch_device_that_is_not_there_ends_the_worker_at_once(random_bundle):
    with pytest.raises(DreamfleetError, match="'sun'"):
        Pool("dream", random_bundle, 1, torch_device="sun")
