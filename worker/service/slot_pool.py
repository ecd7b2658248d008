"""All scoring slots of a worker. Pages: share-a-fleet.md, gpu.md."""

import logging
import math
import queue
from collections.abc import Callable, Sequence
from time import monotonic
from typing import Any

from dreamfleet.common.protocol.messages import MAX_LEASES, TAG_BYTES, Job, Result, RunningJob
from dreamfleet.common.protocol.result_bounds import clamp_count
from dreamfleet.worker.scoring.drive_count import DriveCount
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.child import ChildReady, ScorerArguments
from dreamfleet.worker.service.child_process import EXIT_GRACE
from dreamfleet.worker.service.failure_log import FailureLog
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import JobWithVector
from dreamfleet.worker.service.slot import Slot, SlotEvent
from dreamfleet.worker.service.slot_budget import RunSlots
from dreamfleet.worker.tasks.batches import BatchedTask
from dreamfleet.worker.tasks.registry import check_task_allowed, find_task

log = logging.getLogger(__name__)


TORCH_MEMORY = 8 << 30  # bytes more that a slot may hold that uses a torch device, whose libraries are large
BATCH_INTERVAL = 0.01  # seconds without another job after which a part of a batch is scored
LONGEST_WAIT = 0.1  # seconds after which it is scored though jobs go on to trickle in
IDLE_CHILD = 60.0  # seconds without a job after which a child that is not the last one ends, beside other runs


class SlotPool:
    """The slots that score one run's task, as many at once as its part of the budget allows; `stop` kills the children.

    A worker that may serve several runs starts one child, and further ones as jobs need them.
    """

    def __init__(
        self,
        share: RunSlots,
        arguments: ScorerArguments,
        events: queue.SimpleQueue[tuple[str, Any]],
        memory_limit: int,
        restore_bundle: Callable[[], object] = lambda: None,
        *,
        all_at_once: bool = True,
    ) -> None:
        """`RefusedError` for a task that is not allowed; `memory_limit` is in bytes a slot, 0 means none.

        With `all_at_once` all children start now and stay.
        """
        name = arguments.spec.task
        check_task_allowed(name, arguments.allowed_tasks)
        self._share, self._all_at_once = share, all_at_once
        self._task, task = name, find_task(name)
        self.torch_device = arguments.torch_device
        size = getattr(task, "torch_batch_size", 0) if arguments.torch_device else 0
        memory_limit += TORCH_MEMORY if size and memory_limit else 0
        self._batch_size: int | None = size or task.batch_size if isinstance(task, BatchedTask) else None
        self._whole_batches = size > 0  # a torch device takes as long for a part of a batch
        self._jobs_before = 0  # in the backlog, at the last `fill`
        self._grew_at = self._waits_since = 0.0  # when jobs last arrived, and when the first of them did
        self.awaits_jobs = False  # whether a part of a batch waits for the rest, which may be on its way
        self._drive_count = DriveCount()  # the first child that is ready reports the most
        self._failures = FailureLog()
        self.host_class = ""  # reported by the first child that is ready
        self._watched = False
        self._shown_slot: Slot | None = None
        self._slots: list[Slot] = []
        self._used_at: dict[int, float] = {}  # when each slot last had a job, by number
        try:
            for number in range(share.total):
                parked = number > 0 and not all_at_once
                slot = Slot(number, arguments, events, memory_limit, restore_bundle, parked=parked)
                self._slots.append(slot)
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
    def ready_count(self) -> int:
        """How many slots can score, those included whose children start with their first job."""
        ready = sum(slot.ready for slot in self._slots)
        return ready + sum(slot.parked for slot in self._slots) if ready else 0

    @property
    def capacity(self) -> int:
        """How many jobs this run can count on to be scored at once, beside the worker's other runs.

        R14: the coordinator gives this worker at most twice as many jobs, so that little is lost with it.
        """
        return min(min(self.ready_count, self._share.allowance) * self._jobs_a_slot, MAX_LEASES // 2)

    @property
    def side_by_side(self) -> int:
        """Candidates' drives that a slot does side by side."""
        return self._drive_count.best

    @property
    def taken(self) -> int:
        """How many jobs of its capacity would wait now, because the worker's other runs use the slots.

        R17: such a slot is not idle, so it takes over no job of another worker and copies none.
        """
        return max(0, self.capacity - self._share.usable * self._jobs_a_slot)

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
        """Give jobs from the backlog to free slots, as far as the other runs leave some.

        R26: nothing starts while too many results, `undelivered`, wait for a verdict, so the outbox stays bounded.
        """
        self.awaits_jobs = self._must_wait(len(backlog))
        if self.awaits_jobs:
            return
        room = 4 * len(self._slots) * self._jobs_a_slot - undelivered
        idle = [slot for slot in self._slots if slot.idle and room >= 0]
        groups = self._count_groups(backlog)
        self._settle(min(groups, len(idle)), has_jobs=groups > 0)
        for slot in idle:
            if not len(backlog) or not self._share.take():
                break
            if not self._submit(slot, backlog):
                idle = []  # the jobs' vectors are not whole yet, so this run waits for none of the slots
                break
        ahead = [slot for slot in self._slots if slot.can_queue_another and room > 0]
        for slot in ahead:
            if not (len(backlog) and self._share.goes_on() and self._submit(slot, backlog)):
                break
        groups = self._count_groups(backlog)
        self._settle(min(groups, sum(slot.idle for slot in idle)), has_jobs=groups > 0)
        self._share.pass_on()
        self._start_children(groups)
        if self._watched and self._shown_slot is not None and not self._shown_slot.running:
            self._switch_shown_slot()

    def yield_idle_slots(self) -> None:
        """Leave the slots that score nothing to the other runs."""
        self.awaits_jobs = False
        self._settle(0, has_jobs=False)
        self._share.pass_on()

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
            self._drive_count.most = event.message.side_by_side
        if event.failure is not None:
            # A child that is not ready yet has started no job, so none is named.
            text = self._failures.format_if_new(event.failure, self._task, slot.running if slot.ready else ())
            if text is not None:
                log.error("%s", text)
        jobs = slot.running
        results = slot.handle(event)
        if self._batch_size is None and slot is not self._shown_slot:
            self._measure(jobs, results)
        return results

    def check(self, now: float, gap: float) -> None:
        """Kill children that hang; `gap` is for how many seconds before `now` this host was suspended."""
        for slot in self._slots:
            slot.check(now, gap)
        if not self._all_at_once:
            self._end_unused_child(now)

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
        """Kill all children; wait at most about `EXIT_GRACE` seconds for their end. The other runs get the slots."""
        self._share.close()
        for slot in self._slots:
            slot.kill()
        until = monotonic() + EXIT_GRACE
        for slot in self._slots:
            slot.stop(max(0.0, until - monotonic()))

    def _must_wait(self, jobs: int) -> bool:
        """Whether so many jobs are a part of a batch whose rest is on its way."""
        now, grew = monotonic(), jobs > self._jobs_before
        self._jobs_before = jobs
        if not self._whole_batches or not 0 < jobs < self._jobs_a_slot:
            return False
        if grew:
            self._grew_at = now
            self._waits_since = self._waits_since if self.awaits_jobs else now
        return now - self._grew_at < BATCH_INTERVAL and now - self._waits_since < LONGEST_WAIT

    def _submit(self, slot: Slot, backlog: Backlog) -> bool:
        """Give a slot the next group, if one is whole."""
        drives = self._count_drives(backlog)
        work = backlog.take(self._batch_size or drives, drives)
        if work:
            self._used_at[slot.number] = monotonic()
            slot.submit(work)
        return bool(work)

    @property
    def _jobs_a_slot(self) -> int:
        """Candidates' jobs that a slot scores at once."""
        return self._batch_size or self.side_by_side

    def _measure(self, jobs: Sequence[Job], results: Sequence[Result]) -> None:
        """Note how long a group took, if all its jobs were candidates' and none failed."""
        if results and all(job.kind == "score" for job in jobs) and all(each.fitness is not None for each in results):
            self._drive_count.add(
                len(results), sum(each.steps for each in results), sum(each.seconds for each in results)
            )

    def _count_drives(self, backlog: Backlog) -> int:
        """How many drives a slot takes at once.

        A drive beside others saves less time than a slot without any loses. So as the drives run out, their groups
        shrink.
        """
        return self._drive_count.choose(math.ceil(len(backlog) / len(self._slots)))

    def _count_groups(self, backlog: Backlog) -> int:
        """How many slots the waiting jobs could use, about."""
        each = self._batch_size if self._batch_size and not backlog.is_driven else self._count_drives(backlog)
        return math.ceil(len(backlog) / each)

    def _settle(self, wanted: int, *, has_jobs: bool) -> None:
        self._share.settle(sum(bool(slot.running) for slot in self._slots), wanted, has_jobs=has_jobs)

    def _start_children(self, groups: int) -> None:
        """Start as many parked slots as `groups` more need, and the other runs leave room for."""
        parked = [slot for slot in self._slots if slot.parked]
        if not parked or not groups or not any(slot.ready for slot in self._slots):
            return
        started = len(self._slots) - len(parked)
        busy = sum(bool(slot.running) for slot in self._slots)
        for slot in parked[: max(0, min(self._share.allowance, busy + groups) - started)]:
            slot.start()

    def _end_unused_child(self, now: float) -> None:
        """End the child of one slot that got no job for a while, unless it is the last."""
        idle = [slot for slot in self._slots if slot.idle]
        unused = [slot for slot in idle[1:] if now - self._used_at.setdefault(slot.number, now) > IDLE_CHILD]
        if unused:
            del self._used_at[unused[-1].number]
            unused[-1].park()

    def _switch_shown_slot(self) -> None:
        """Let the first slot that scores send frames instead of one that idles."""
        another = next((slot for slot in self._slots if slot.running), self._shown_slot or self._slots[0])
        if another is not self._shown_slot:
            if self._shown_slot is not None:
                self._shown_slot.show(False)
            another.show(True)
            self._shown_slot = another
