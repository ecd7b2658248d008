"""How the jobs of a backlog are divided among a worker's slots."""

import math
import queue
from time import sleep

import numpy as np
import pytest

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.protocol.messages import JobBatch, TaskSpec, VectorPart
from dreamfleet.worker.scoring.drive_count import ENOUGH
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.service import slot_pool
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.child import ScorerArguments
from dreamfleet.worker.service.slot_budget import SharedSlots
from dreamfleet.worker.service.slot_pool import SlotPool
from tests.support import rough_tasks, tasks
from tests.support.processes import DEADLINE
from tests.support.samples import HEAD, VECTOR, VECTOR_ID, job

WHOLE = VectorPart(id=VECTOR_ID, dtype="<f4", shape=(16,), offset=0, data=VECTOR)
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
        """Put jobs into the backlog, as one batch."""
        number = self.backlog.seen + 1
        self.backlog.add_batch(
            JobBatch(
                **HEAD, nonce="n", numbering=0, number=number, vectors=(WHOLE,), jobs=jobs, cancels=(), verdicts=()
            )
        )

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
    assert (fleet.slots.together, fleet.slots.capacity) == (4, 8)
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
    assert (fleet.slots.together, fleet.slots.capacity) == (2, 2)


def test_a_few_jobs_go_to_as_many_slots(pool):
    assert pool(SIDE_BY_SIDE).score(2)[2] == [1, 1]


@pytest.mark.parametrize("task", [f"{rough_tasks.MODULE}:OnlyOne", f"{tasks.MODULE}:OneByOne"])
def test_without_a_second_environment_or_such_a_policy_jobs_are_scored_one_by_one(pool, task):
    fleet = pool(task)
    assert (fleet.slots.together, fleet.slots.capacity) == (1, 2)
    assert fleet.score(5)[2] == [1] * 5


def test_on_a_torch_device_a_part_of_a_batch_waits_for_the_rest_that_arrives(pool, monkeypatch):
    monkeypatch.setattr(slot_pool, "BATCH_INTERVAL", math.inf)
    monkeypatch.setattr(slot_pool, "LONGEST_WAIT", math.inf)
    fleet = pool(f"{tasks.MODULE}:OnTorch", slots=1, torch_device="cpu")
    assert fleet.slots.capacity == 8
    jobs = [job(number, spec=fleet.spec) for number in range(16)]
    (slot,) = fleet.slots._slots
    for part in (jobs[:3], jobs[3:6]):
        fleet.add(tuple(part))
        fleet.slots.fill(fleet.backlog, 0)
        assert (fleet.slots.awaits_jobs, slot.running) == (True, [])
    fleet.slots.fill(fleet.backlog, 0)  # of another event
    assert (fleet.slots.awaits_jobs, slot.running) == (True, [])
    monkeypatch.setattr(slot_pool, "BATCH_INTERVAL", 0.0)
    fleet.slots.fill(fleet.backlog, 0)  # no more came meanwhile
    assert (fleet.slots.awaits_jobs, len(slot.running)) == (False, 6)
    while slot.running:
        fleet.take()
    fleet.add(tuple(jobs[6:]))
    fleet.slots.fill(fleet.backlog, 0)
    assert (fleet.slots.awaits_jobs, len(slot.running), len(slot.waiting)) == (False, 8, 2)


def test_jobs_that_trickle_in_wait_not_for_ever(pool, monkeypatch):
    fleet = pool(f"{tasks.MODULE}:OnTorch", slots=1, torch_device="cpu")
    monkeypatch.setattr(slot_pool, "BATCH_INTERVAL", math.inf)
    (slot,) = fleet.slots._slots
    fleet.add((job(0, spec=fleet.spec),))
    fleet.slots.fill(fleet.backlog, 0)
    assert (fleet.slots.awaits_jobs, slot.running) == (True, [])
    sleep(slot_pool.LONGEST_WAIT)
    fleet.add((job(1, spec=fleet.spec),))
    fleet.slots.fill(fleet.backlog, 0)
    assert (fleet.slots.awaits_jobs, len(slot.running)) == (False, 2)


def test_without_a_torch_device_no_part_of_a_batch_waits(pool):
    fleet = pool(f"{tasks.MODULE}:OnTorch", slots=1)
    assert fleet.slots.capacity == 256
    assert fleet.score(3)[2] == [3]


@pytest.mark.add_on
def test_a_torch_device_that_is_not_there_ends_the_worker_at_once(random_bundle):
    with pytest.raises(DreamfleetError, match="'sun'"):
        Pool("dream", random_bundle, 1, torch_device="sun")
