"""One incarnation of a coordinator: `Run` and `WorkerProtocol`, driven as `Service` drives them, on a simulated disk.

The only module that knows how the coordinator's parts are driven; what their books hold is read in `books.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from dreamfleet.common.protocol.messages import HelloRequest, Intervals, JobBatch
from dreamfleet.coordinator.dispatch.packing import SentBatch
from dreamfleet.coordinator.jobs import rollout_collection
from dreamfleet.coordinator.optimisers import evolution
from dreamfleet.coordinator.run.report import ControllerWriter
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.run.worker_protocol import WorkerProtocol
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.settings.network import NetworkConfig
from tests.simulation.disk import Disk, SimulatedJournal
from tests.simulation.schedule import Shape
from tests.simulation.truth import Strategy, settings_of

if TYPE_CHECKING:
    from tests.simulation.witness import Witness

BEAT = REPEAT = 1.0  # virtual seconds, as the run's intervals say
TICK = 0.25  # virtual seconds between turns without a message; the product's are shorter, and cost as much
LINGER = 0.005

HOST_KEY = bytes(32)  # of the coordinator's own host

OPENED, COMMITTED = "opened", "committed"
Step = SentBatch | str | None
"""A batch to send, the name of a moment, or any other moment at which a life may end."""


@contextmanager
def simulated_surroundings(disk_of: Any) -> Iterator[None]:
    """No file is written, and no registry is asked: `disk_of()` is the disk of the play that is on."""
    with ExitStack() as stack:
        enter = stack.enter_context
        enter(patch.object(rollout_collection, "atomic_write", lambda path: disk_of().atomic_write(path)))
        enter(patch.object(ControllerWriter, "save", lambda self, **_: None))
        enter(patch.object(evolution, "build_optimiser", lambda name, search: Strategy(search)))
        enter(patch.object(evolution, "check_memory", lambda *_: None))
        yield


class Coordinator:
    """A life that begins from what the disk holds."""

    def __init__(
        self, disk: Disk, witness: Witness, shape: Shape, life: int, now: float, *, is_secured: bool = False
    ) -> None:
        self.nonce = f"{life:016x}"
        limits = LimitsConfig(generations=shape.generations if shape.ends else 0)
        network = NetworkConfig(beat=BEAT, verify=shape.verify, failure_limit=1.0)
        journal = SimulatedJournal(disk, witness)
        self.run = Run(journal, settings_of(shape), limits, network, now, HOST_KEY, is_secured=is_secured)
        self.fleet = self.run.fleet
        self.worker_protocol = WorkerProtocol(self.run, "simulated", self.nonce, Intervals(BEAT, REPEAT))
        self.draining = False
        self.commit_at = 0.0

    def hear(self, worker: str, message: Any, now: float) -> None:
        """One event, as `Service._handle` takes it; hello is `welcome`."""
        if message == "gone":
            self.fleet.handle_departure(worker, now)
        else:
            self.worker_protocol.handle(worker, message, now)

    def welcome(self, request: HelloRequest, now: float) -> int | None:
        """How its batches are numbered; `None` where the worker may not join."""
        reply = self.worker_protocol.answer_hello(request, None, now)
        return reply.numbering if reply.accepted else None

    def turn(self, now: float) -> Iterator[Step]:
        """What follows the events in a turn of the loop, step by step: a life may end between any two."""
        yield None
        self.run.tick(now)
        opened = self.run.advance(now)
        if opened:
            yield OPENED
        if not self.run.state.is_rewound:
            yield from self.fleet.dispatch(now, durable=False)
        yield None
        goes_on = not (self.run.state.is_over or self.run.state.stalled)
        if not opened and goes_on and self.fleet.lease_count and now < self.commit_at:
            return
        self.run.commit()
        self.commit_at = now + LINGER
        yield COMMITTED
        if self.run.state.is_rewound:
            return
        yield from self.fleet.dispatch(now)
        self.run.generations.prepare()
        self.run.take_notes()

    def batch(self, send: SentBatch) -> JobBatch:
        """A send as it travels."""
        return self.worker_protocol.job_batch(send)

    @property
    def over(self) -> bool:
        """Whether this life leaves by itself: the run has ended or was rewound, or a drain is done."""
        return self.run.state.is_over or (self.draining and not self.fleet.lease_count)
