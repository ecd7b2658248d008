"""A generation's cost does not grow with the run: journal, history, evaluations and status."""

import logging
from dataclasses import replace
from statistics import median
from time import process_time

import numpy as np
import pytest

from dreamfleet.common.protocol.messages import Heartbeat, HelloRequest, Intervals, Result, ResultBatch
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.run.worker_protocol import WorkerProtocol
from dreamfleet.coordinator.service.snapshot import take_snapshot
from dreamfleet.coordinator.service.status import encode_status
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from dreamfleet.coordinator.storage.journal import Journal
from tests.support.run_bench import SETTINGS, A

BLOCK = 250  # generations of a measurement


class LongRun:
    """A run whose only worker answers at once; each generation is evaluated and its status encoded."""

    def __init__(self, folder, bundle):
        folder.mkdir()
        settings = replace(SETTINGS, population=4, evaluate_every=1, collect_every=0)
        self.run = Run(Journal.create(folder, settings, bundle), settings, LimitsConfig(), NetworkConfig(), 0.0)
        self.worker_protocol = WorkerProtocol(self.run, "long", "n", Intervals(1.0, 1.0))
        self.now, self.seen = 0.0, 0
        self.run.admission.admit(HelloRequest(2, 2, "0", A, (settings.task.task,), "f", 1), self.now)

    def cost(self):
        """Processor time of one more generation, in seconds."""
        begun, closed = process_time(), len(self.run.history)
        while len(self.run.history) == closed:
            self.now += 0.01
            self.worker_protocol.handle_heartbeat(A, self.handle_heartbeat(), self.now)
            for send in self.run.fleet.dispatch(self.now):
                self.seen = max(self.seen, send.number)
                self.answer(send.work)
            self.run.advance(self.now)
            self.run.commit()
        encode_status(take_snapshot(self.run, "long", {}, self.now, self.now))
        self.run.take_notes()
        return process_time() - begun

    def handle_heartbeat(self):
        head = {"run_uid": self.run.uid, "incarnation": 1, "nonce": "n", "numbering": 1, "drawn_by": "-"}
        return Heartbeat(
            **head,
            seen=self.seen,
            capacity=8,
            slots=8,
            queued=(),
            running=(),
            unacked=(),
            load=0.0,
            steps_per_second=0.0,
        )

    def answer(self, work):
        results = tuple(Result(each.job.digest, score(each), 10, 0.1, None, None) for each in work)
        batch = ResultBatch(run_uid=self.run.uid, incarnation=1, fingerprint="f", results=results)
        self.worker_protocol.handle_results(A, batch, self.now)


def score(work):
    """The negative distance to a moving goal, so that the search never converges."""
    goal = np.cos(0.1 * work.job.generation)
    return -float(np.square(np.frombuffer(work.vector, "<f4") - goal).sum())


def blocks_of(folder, bundle, generations):
    """The median generation's cost in each block of a run."""
    run = LongRun(folder, bundle)
    return [median(run.cost() for _ in range(BLOCK)) for _ in range(generations // BLOCK)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "generations",
    [1_000, pytest.param(100_000, marks=[pytest.mark.long, pytest.mark.timeout(3600)])],
)
def test_a_late_generation_costs_no_more_than_an_early_one(tmp_path, random_bundle, generations):
    costs = blocks_of(tmp_path / "run", random_bundle.path, generations)
    logging.getLogger(__name__).info("ms: %s", [round(1000 * cost, 2) for cost in costs[:: max(len(costs) // 10, 1)]])
    assert min(costs[-2:]) < 1.5 * min(costs[:2])
