"""All scoring slots of a worker."""

from __future__ import annotations

import logging
import queue
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import Any

from dreamfleet.common.protocol.messages import MAX_LEASES, TAG_BYTES, Job, Result, RunningJob, TaskSpec
from dreamfleet.common.protocol.result_bounds import clamp_count
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.child import ChildReady
from dreamfleet.worker.service.child_process import EXIT_GRACE
from dreamfleet.worker.service.failure_log import FailureLog
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import JobWithVector
from dreamfleet.worker.service.slot import Slot, SlotEvent
from dreamfleet.worker.tasks.registry import check_task_allowed, find_task

log = logging.getLogger(__name__)


class SlotPool:
    """The slots that score one task; `stop` kills their children."""

    def __init__(
        self,
        count: int,
        spec: TaskSpec,
        bundle: Path | None,
        events: queue.SimpleQueue[tuple[str, Any]],
        allowed_tasks: tuple[str, ...],
        memory_limit: int,
        restore_bundle: Callable[[], object] = lambda: None,
    ) -> None:
        """`RefusedError` for a task that is not in `allowed_tasks`; `memory_limit` is in bytes a slot, 0 means none."""
        check_task_allowed(spec.task, allowed_tasks)
        self._task = spec.task
        self._batch_size = find_task(spec.task).batch_size
        self._failures = FailureLog()
        self.host_class = ""  # reported by the first child that is ready
        self._watched = False
        self._shown_slot: Slot | None = None
        self._slots: list[Slot] = []
        try:
            for number in range(count):
                self._slots.append(Slot(number, spec, bundle, events, allowed_tasks, memory_limit, restore_bundle))
        except BaseException:
            self.stop()  # otherwise the interpreter would wait for these children at exit, and they for it
            raise

    def __len__(self) -> int:
        return len(self._slots)

    @property
    def busy(self) -> bool:
        """Whether any slot scores."""
        return any(slot.running for slot in self._slots)

    @property
    def idle(self) -> bool:
        """Whether a slot could score and none does."""
        return any(slot.ready for slot in self._slots) and not self.busy

    @property
    def capacity(self) -> int:
        """How many jobs the ready slots score at once.

        R14: the coordinator gives this worker at most twice as many jobs, so that little is lost with it.
        """
        return min(sum(slot.ready for slot in self._slots) * self._batch_size, MAX_LEASES // 2)

    @property
    def steps(self) -> int:
        """Environment steps of all running jobs so far."""
        return sum(slot.steps for slot in self._slots)

    @property
    def running(self) -> list[RunningJob]:
        """Each running job, with its share of its group's steps."""
        return [
            RunningJob(job.digest[:TAG_BYTES], clamp_count(slot.steps // len(slot.running)))
            for slot in self._slots
            for job in slot.running
        ]

    @property
    def waiting(self) -> list[Job]:
        """Jobs that are queued in a child and have not started."""
        return [job for slot in self._slots for job in slot.waiting]

    @property
    def drawn_by(self) -> str:
        """What draws the pictures; `-` if unknown."""
        return next((slot.drawn_by for slot in self._slots if slot.ready), "-")

    def fill(self, backlog: Backlog, undelivered: int) -> None:
        """Give jobs from the backlog to free slots.

        R26: nothing starts while too many results, `undelivered`, wait for a verdict, so the outbox stays bounded.
        """
        room = 4 * len(self._slots) * self._batch_size - undelivered
        idle = [slot for slot in self._slots if slot.idle and room >= 0]
        ahead = [slot for slot in self._slots if slot.can_queue_another and room > 0]
        for slot in idle + ahead:
            if work := backlog.take(self._batch_size):
                slot.submit(work)
        if self._watched and self._shown_slot is not None and not self._shown_slot.running:
            self._switch_shown_slot()

    def show(self, wanted: bool) -> None:
        """Have one slot send frames, or none."""
        self._watched = wanted
        if self._shown_slot is not None:
            self._shown_slot.show(False)
            self._shown_slot = None
        if wanted:
            self._switch_shown_slot()

    def find_job(self, number: int, child_number: int, frame: SampledFrame) -> JobWithVector | None:
        """The job that a slot's frame shows; `None` if it is over."""
        return self._slots[number].find_job(child_number, frame)

    def handle(self, event: SlotEvent) -> tuple[Result, ...]:
        """Handle a slot's event; return the results that it brings."""
        slot = self._slots[event.slot]
        if isinstance(event.message, ChildReady):
            self.host_class = self.host_class or event.message.host_class
        if event.failure is not None:
            # A child that is not ready yet has started no job, so none is named.
            text = self._failures.format_if_new(event.failure, self._task, slot.running if slot.ready else ())
            if text is not None:
                log.error("%s", text)
        return slot.handle(event)

    def check(self, now: float, gap: float) -> None:
        """Kill children that hang; `gap` is for how many seconds before `now` this host was suspended."""
        for slot in self._slots:
            slot.check(now, gap)

    @property
    def wanted_digests(self) -> set[bytes]:
        """Digests of the wanted jobs that a slot has, started or not."""
        return set().union(*(slot.wanted_digests for slot in self._slots))

    def abandon(self, digest: bytes) -> None:
        """Mark a job as unwanted in every slot."""
        for slot in self._slots:
            slot.abandon(digest)

    def abandon_waiting(self) -> None:
        """Abandon the jobs that have not started."""
        for job in self.waiting:
            self.abandon(job.digest)

    def stop(self) -> None:
        """Kill all children; wait at most about `EXIT_GRACE` seconds for their end."""
        for slot in self._slots:
            slot.kill()
        until = monotonic() + EXIT_GRACE
        for slot in self._slots:
            slot.stop(max(0.0, until - monotonic()))

    def _switch_shown_slot(self) -> None:
        """Let the first slot that scores send frames instead of one that idles."""
        another = next((slot for slot in self._slots if slot.running), self._shown_slot or self._slots[0])
        if another is not self._shown_slot:
            if self._shown_slot is not None:
                self._shown_slot.show(False)
            another.show(True)
            self._shown_slot = another
