"""How the jobs of a backlog are divided among a worker's slots."""

import queue

import numpy as np
import pytest

from dreamfleet.common.protocol.messages import JobBatch, TaskSpec, VectorPart
from dreamfleet.worker.scoring.scorer import Scorer
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
    def __init__(self, task, bundle, slots):
        self.spec = TaskSpec(task=task, bundle=bundle.sha256, horizon=100, patience=0)
        self.events = queue.SimpleQueue()
        share = SharedSlots(slots).open(1.0, lambda: None)
        self.slots = SlotPool(share, ScorerArguments(self.spec, bundle.path, (task,)), self.events, 0)
        self.backlog = Backlog(self.spec)
        while self.slots.ready_count < slots:
            self.take()

    def take(self):
        return self.slots.handle(self.events.get(timeout=DEADLINE)[1])

    def score(self, count):
        """So many jobs, their fitness by digest, and the sizes of the groups in the order in which they began."""
        jobs = tuple(job(number, spec=self.spec) for number in range(count))
        self.backlog.add_batch(
            JobBatch(**HEAD, nonce="n", numbering=0, number=1, vectors=(WHOLE,), jobs=jobs, cancels=(), verdicts=())
        )
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

    def make(task, slots=2):
        made.append(Pool(task, random_bundle, slots))
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


def test_a_few_jobs_go_to_as_many_slots(pool):
    assert pool(SIDE_BY_SIDE).score(2)[2] == [1, 1]


def test_where_a_second_environment_cannot_be_made_jobs_are_scored_one_by_one(pool):
    fleet = pool(f"{rough_tasks.MODULE}:OnlyOne")
    assert (fleet.slots.together, fleet.slots.capacity) == (1, 2)
    assert fleet.score(5)[2] == [1] * 5


def test_jobs_of_a_task_without_such_a_policy_are_scored_one_by_one(pool):
    fleet = pool(f"{tasks.MODULE}:OneByOne")
    assert (fleet.slots.together, fleet.slots.capacity) == (1, 2)
    assert fleet.score(5)[2] == [1] * 5
