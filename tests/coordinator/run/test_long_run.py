"""A generation's cost does not grow with the run: journal, history, evaluations and status."""

from dataclasses import replace
from statistics import median
from time import process_time

import numpy as np
import pytest

from dreamfleet.coordinator.service.snapshot import take_snapshot
from dreamfleet.coordinator.service.status import encode_status
from tests.support.dispatched import result
from tests.support.run_bench import SETTINGS, A, B, Bench

BLOCK, BLOCKS = 250, 400  # generations of a measurement, and how many there are


class LongRun(Bench):
    """A run whose workers answer at once; each generation is evaluated and its status encoded."""

    def cost(self):
        """Processor time of one more generation, in seconds."""
        begun, closed = process_time(), len(self.run.history)
        while len(self.run.history) == closed:
            self.now += 0.01
            for name in (A, B):
                self.handle_heartbeat(name)
            for send in self.run.fleet.dispatch(self.now):
                for work in send.work:
                    self.deliver(send.identity, result(work.digest, score(work)))
        encode_status(take_snapshot(self.run, "long", {}, self.now, self.now))
        self.run.take_notes()
        return process_time() - begun


def score(work):
    """The negative distance to a moving goal, so that the search never converges."""
    goal = np.cos(0.1 * work.job.generation)
    return -float(np.square(np.frombuffer(work.vector, "<f4") - goal).sum())


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_a_late_generation_costs_no_more_than_an_early_one(make_bench):
    run = make_bench(LongRun, replace(SETTINGS, population=4, evaluate_every=1, collect_every=0), generations=0)
    costs = [median(run.cost() for _ in range(BLOCK)) for _ in range(BLOCKS)]
    assert min(costs[-2:]) < 1.5 * min(costs[:2]), [round(1000 * cost, 2) for cost in costs]
