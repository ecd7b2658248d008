"""One life of a coordinator: `Run` and `WorkerProtocol`, driven as `Service` drives them, on a simulated disk.

The only module that knows how the coordinator's parts are driven; what their books hold is read in `books.py`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, cast
from unittest.mock import patch

from dreamfleet.common.protocol.messages import Heartbeat, HelloRequest, JobBatch, ResultBatch, UploadPart
from dreamfleet.coordinator.dispatch.fleet import Fleet
from dreamfleet.coordinator.dispatch.packing import OutgoingBatch
from dreamfleet.coordinator.jobs import rollout_collection
from dreamfleet.coordinator.optimisers import evolution
from dreamfleet.coordinator.run.report import ControllerWriter
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.settings.config import LimitsConfig
from dreamfleet.coordinator.storage.journal import Journal
from tests.simulation.disk import Disk, MemoryJournal, Witness
from tests.simulation.schedule import Shape
from tests.simulation.truth import Strategy, settings_of

BEAT = REPEAT = 1.0  # virtual seconds, as the run's intervals say
TICK = 0.25  # virtual seconds between turns without a message; the product's are shorter, and cost as much
LINGER = 0.005

OPENED, COMMITTED = "opened", "committed"
Step = OutgoingBatch | str | None
"""A batch to send, the name of a moment, or any other moment at which a life may end."""


@contextmanager
def simulated_surroundings(disk_of: Any) -> Iterator[None]:
    """No file is written, and no registry is asked: `disk_of()` is the disk of the play that is on."""
    with ExitStack() as stack:
        enter = stack.enter_context
        enter(patch.object(rollout_collection, "atomic_write", lambda path: disk_of().atomic_write(path)))
        enter(patch.object(ControllerWriter, "save", lambda self, **_: None))
        enter(patch.object(evolution, "build_optimiser", lambda name, search: Strategy(search)))
        yield


class Coordinator:
    """A life that begins from what the disk holds."""

    def __init__(self, disk: Disk, witness: Witness, shape: Shape, life: int, now: float) -> None:
        self.nonce = f"{life:016x}"
        self.fleet = Fleet(BEAT)
        limits = LimitsConfig(generations=shape.generations if shape.ends else 0)
        journal = cast(Journal, MemoryJournal(disk, witness))
        self.run = Run(journal, settings_of(shape), limits, self.fleet, now)
        self.worker_protocol = self.run.worker_protocol
        self.draining = False

    def hear(self, worker: str, message: Any, now: float) -> None:
        """One event, as `Service._handle` takes it; hello is `welcome`."""
        if isinstance(message, ResultBatch):
            self.worker_protocol.handle_results(worker, message, now)
        elif isinstance(message, Heartbeat):
            if message.nonce == self.nonce:
                self.worker_protocol.handle_heartbeat(worker, message, now)
        elif isinstance(message, UploadPart):
            self.worker_protocol.upload(worker, message, now)
        else:
            assert message == "gone"
            self.worker_protocol.handle_departure(worker, now)

    def welcome(self, request: HelloRequest, now: float) -> int | None:
        """How its batches are numbered; `None` where the worker may not join."""
        if self.worker_protocol.find_refusal(request, self.run.settings):
            return None
        return self.worker_protocol.admit(request, now)

    def turn(self, now: float) -> Iterator[Step]:
        """What follows the events in a turn of the loop, step by step: a life may end between any two."""
        yield None
        self.worker_protocol.tick(now)
        if self.run.advance(now):
            yield OPENED
            yield from self.worker_protocol.dispatch(now, durable=False)
        yield None
        self.run.commit()
        yield COMMITTED
        yield from self.worker_protocol.dispatch(now)
        self.run.prepare()
        self.run.take_closed()
        self.worker_protocol.take_notes()

    def batch(self, send: OutgoingBatch) -> JobBatch:
        """A send as it travels."""
        content = send.content
        return JobBatch(
            run_uid=self.run.uid,
            incarnation=self.run.incarnation,
            nonce=self.nonce,
            numbering=send.numbering,
            number=send.number,
            vectors=tuple(content.vectors),
            jobs=tuple(work.job for work in content.work),
            cancels=tuple(content.cancels),
            verdicts=tuple(content.verdicts),
        )

    @property
    def over(self) -> bool:
        """Whether this life leaves by itself: the run has ended, or a drain is done."""
        return self.run.ended is not None or (self.draining and not self.worker_protocol.lease_count)
