"""Answer as a coordinator over real Zenoh, from snapshots that a test makes."""

import dataclasses
from contextlib import contextmanager
from logging import getLogger
from types import SimpleNamespace

from dreamfleet.common.client.status import WorkerCount
from dreamfleet.common.host.error_counter import ErrorCounter
from dreamfleet.common.runs.records import StoredEvaluation
from dreamfleet.common.transport.session import Network, open_session
from dreamfleet.coordinator.dispatch.event_log import EventLog
from dreamfleet.coordinator.jobs.generation import CandidateScores
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.service.queryables import declare_status
from dreamfleet.coordinator.service.snapshot import Snapshot
from tests.support.samples import CLOSED, STATUS

WORKER = STATUS.worker_list[0]


def snapshot(generations=8, workers=1, population=16, name="night", **changes):
    """A snapshot of a run with so many closed generations and workers."""
    history = History(
        dataclasses.replace(CLOSED, number=number, mean=float(number % 300), best=50.0 + number % 300, sigma=0.1)
        for number in range(generations)
    )
    looks = tuple(StoredEvaluation(number, 16, 100.0 + number % 300, 20.0) for number in range(4, generations, 5))
    fleet = tuple(
        dataclasses.replace(WORKER, worker=f"host-{index // 4:03d}/{index:08x}", steps_per_second=100.0 * (index % 9))
        for index in range(workers)
    )
    half = population // 2
    candidate_scores = CandidateScores(
        generations, [2] * half + [0] * (population - half), [2] * population,
        [float(index) for index in range(half)] + [None] * (population - half),
    )  # fmt: skip
    status = dataclasses.replace(
        STATUS, run=name, generation=dataclasses.replace(STATUS.generation, number=generations),
        generations=generations, last=history.last, recent=(), worker_list=(), workers=WorkerCount(workers, workers, 0),
        population=dataclasses.replace(STATUS.population, generation=generations, total=population),
        evaluation=looks[-1] if looks else None, best=looks[-1] if looks else None, evaluations=len(looks),
        **{"failures": (), "failing": 0, "dropped": {}, **changes},
    )  # fmt: skip
    return Snapshot(status, fleet, history.view(), looks, candidate_scores, None, None, EventLog().view(), 0.0)


@contextmanager
def serving(endpoint, first, *others):
    """Serve at `endpoint` the snapshot `first`, which a test may replace, and `others`."""
    served = SimpleNamespace(snapshot=first)
    with open_session(Network(listen=(endpoint,))) as session:
        error_counter = ErrorCounter(getLogger(__name__))
        declare_status(session, first.status.run, lambda: served.snapshot, error_counter)
        for other in others:
            declare_status(session, other.status.run, lambda other=other: other, error_counter)
        yield served
