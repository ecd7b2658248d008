"""A scoring slot: it keeps one child process running, so that a crashed simulator costs one job and not the worker."""

import logging
import math
import queue
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import Any

from dreamfleet.common.errors import BundleError, DreamfleetError
from dreamfleet.common.host.stall_watch import START_LIMIT, StallWatch, describe_stall
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.messages import Job, Result
from dreamfleet.worker.scoring.failure_cause import is_hosts_fault
from dreamfleet.worker.service.child import ChildReady, ScorerArguments
from dreamfleet.worker.service.child_process import EXIT_GRACE, LOOK_INTERVAL, ChildMessage, ChildProcess
from dreamfleet.worker.service.failure_log import ScoringFailure, describe_jobs
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import GroupDone, JobGroup, JobWithVector

log = logging.getLogger(__name__)
FAILED_STARTS = 3  # failed starts in a row that end the worker (docs/how-to/monitor.md)
STARVED_STARTS = 15  # the same where the host is at fault; the pauses between them add up to 602 seconds
START_RETRY_DELAY = 2.0  # seconds until the next try, where no child could be started; doubled where the host is short
MAX_STARVED_DELAY = 60.0  # the longest of these pauses
MAX_NAME_LENGTH = 100  # characters of `drawn_by`
REMEDY = "give it fewer --slots, or this host more room (ulimit -n, ulimit -u, memory, the disk of temporary files)"
MAX_START_DELAY = 30.0  # the longest pause before a new child, where children end one after another without a result
SHORT_GROUP = 0.25  # seconds; after a group that was shorter, a second group is queued in the child
MAX_PIPELINED_BYTES = 64 * 1024  # bytes of vectors that a pipe accepts while its child is busy


@dataclass(frozen=True)
class SlotEvent:
    """A message from the child number `child_number` of a slot; `None` as the message: the child is gone."""

    slot: int
    child_number: int
    message: ChildMessage

    @property
    def failure(self) -> ScoringFailure | None:
        """What the child raised as it started or while it scored the finished group."""
        if isinstance(self.message, GroupDone):
            return self.message.failure
        return self.message if isinstance(self.message, ScoringFailure) else None

    @property
    def upload(self) -> bytes | None:
        """The rollout file of the finished group."""
        return self.message.upload if isinstance(self.message, GroupDone) else None


class Slot:
    """The parent's side of one child, which scores one group and queues at most one more."""

    def __init__(
        self,
        number: int,
        arguments: ScorerArguments,
        events: queue.SimpleQueue[tuple[str, Any]],
        memory_limit: int = 0,
        restore_bundle: Callable[[], object] = lambda: None,
        *,
        parked: bool = False,
    ) -> None:
        """`memory_limit` is in bytes, 0 means none.

        `restore_bundle` fetches the bundle's file again after a failed start, because others also write to the cache.
        A `parked` slot has no child until `start`.
        """
        self.number = number
        self.ready = False
        self.drawn_by = "-"
        self._arguments = arguments
        self._events = events
        self._memory_limit = memory_limit
        self._restore_bundle = restore_bundle
        self._groups: deque[JobGroup] = deque()
        self._groups_are_short = False  # whether the last one was
        self._watch = StallWatch()  # before the child is ready, it counts from the start
        self._child_number = 0
        self._failed_starts = self._starved_starts = 0  # in a row; the host is at fault for the starved ones
        self._was_ready = False  # whether any child was
        self._useless_children = 0  # children in a row that ended without a finished group
        self._start_at = 0.0
        self._child: ChildProcess | None = None  # `None` until `_start_at`
        self._weigh_at = 0.0  # when the child's memory is looked at next
        self._is_watched = False
        if parked:
            self._clear_child(math.inf)
        else:
            self.start()

    @property
    def parked(self) -> bool:
        """Whether it has no child, and gets none until `start`."""
        return self._start_at == math.inf

    @property
    def running(self) -> list[Job]:
        """Jobs of the group that the child scores now."""
        return self._groups[0].jobs if self._groups else []

    @property
    def waiting(self) -> list[Job]:
        """Jobs that the child has not started."""
        return [job for group in list(self._groups)[1:] for job in group.jobs]

    @property
    def wanted_digests(self) -> set[bytes]:
        """Digests of its jobs that are still wanted."""
        return {job.digest for group in self._groups for job in group.jobs if job.digest not in group.unwanted}

    @property
    def idle(self) -> bool:
        """Whether the child is ready and has nothing to do."""
        return self.ready and not self._groups

    @property
    def can_queue_another(self) -> bool:
        """Whether a second group may be queued in the child, so that it need not wait between short ones."""
        return self.ready and self._groups_are_short and len(self._groups) == 1

    @property
    def steps(self) -> int:
        """Environment steps of the running group so far, over all its jobs."""
        return self._child.steps if self._groups and self._child else 0

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._child.pid if self._child else 0

    def submit(self, work: Sequence[JobWithVector]) -> None:
        """Send the child a group of jobs."""
        group = JobGroup(0, work)
        self._groups.append(group)
        self._send(group)

    def _send(self, group: JobGroup) -> None:
        assert self._child is not None  # the caller has seen one
        if group is self._groups[0]:
            self._watch.restart()
        group.number = self._child.send_group(group.work)

    def show(self, wanted: bool) -> None:
        """Start sending frames with the next group, also after the child is replaced; or stop."""
        self._is_watched = wanted
        if self._child is not None:
            self._child.show(wanted)

    def find_job(self, child_number: int, frame: SampledFrame) -> JobWithVector | None:
        """The job that a frame shows; `None` if its group is no longer running."""
        if child_number != self._child_number or not self._groups or self._groups[0].number != frame.group:
            return None
        work = self._groups[0].work
        return work[frame.episode] if frame.episode < len(work) else None

    def check(self, now: float, gap: float) -> None:
        """Kill a child that makes no steps or does not start; without a child, start one when it is time.

        R21: `gap`, the seconds for which this host was suspended, do not count as hanging.
        """
        if self._child is None:
            if now >= self._start_at:
                self.start()
            return
        quiet = self._watch.quiet_seconds(self.steps, now, gap)
        if self._groups or not self.ready:
            limit = self._groups[0].stall if self.ready else START_LIMIT * 2**self._failed_starts
            if quiet > limit > 0:
                self._child.kill_for(describe_stall(limit, is_ready=self.ready))
        if self._child.is_gone_unheard(now):
            self._events.put(("slot", SlotEvent(self.number, self._child_number, None)))

    def abandon(self, digest: bytes) -> None:
        """Mark a job as unwanted.

        R9: a group without a wanted job ends at its next step, so that no slot works for nothing.
        """
        for group in self._groups:
            digests = {job.digest for job in group.jobs}
            group.unwanted |= {digest} & digests
            if group.unwanted >= digests and group.number and self._child:
                self._child.abandon_group(group.number)

    def handle(self, event: SlotEvent) -> tuple[Result, ...]:
        """Handle one of this slot's events; return the results that it brings."""
        if event.child_number != self._child_number:
            return ()
        if isinstance(event.message, ChildReady):
            self.ready, self.drawn_by = True, truncate(event.message.drawn_by, MAX_NAME_LENGTH) or "-"
            self._failed_starts = self._starved_starts = 0
            self._was_ready = True
            self._watch.restart()
        elif isinstance(event.message, GroupDone):
            running = self._groups[0].number if self._groups else None  # a forked copy of the child may answer again
            return self._finish_group(event.message) if event.message.group == running else ()
        elif isinstance(event.message, ScoringFailure):
            assert self._child is not None  # it has sent this
            self._child.start_failure = event.message.error
        elif not isinstance(event.message, SampledFrame):
            return self._replace_child()
        return ()

    def park(self) -> None:
        """End the idle child, to free its memory."""
        self.stop()
        self._clear_child(math.inf)

    def kill(self) -> None:
        """Kill the child, without waiting for its end; the slot is of no use then."""
        self._child_number += 1
        if self._child is not None:
            self._child.kill()

    def stop(self, seconds: float = EXIT_GRACE) -> None:
        """Kill the child, and wait up to about `seconds` for its end."""
        self._child_number += 1
        if self._child is not None:
            self._child.close(seconds)

    def _finish_group(self, done: GroupDone) -> tuple[Result, ...]:
        """Take a group's results.

        R8: a child may be poisoned by what it scored before, and a small group by one of its jobs. So only a fresh
        child fails a job that it scored alone. Otherwise it is replaced, and the new one scores the failed jobs first.
        """
        group = self._groups.popleft()
        self._useless_children = 0
        self._groups_are_short = (
            group.largest_size <= MAX_PIPELINED_BYTES
            and bool(done.results)
            and sum(each.seconds for each in done.results) < SHORT_GROUP
        )
        self._watch.restart()
        failed = {each.digest for each in done.results if each.fitness is None}
        if failed and (group.number > 1 or group.is_small):
            self._groups.extendleft(reversed(group.split(failed)))
            jobs = [job for job in group.jobs if job.digest in failed]
            log.warning("slot %d failed%s; a fresh process tries again", self.number, describe_jobs(jobs))
            self._restart()
            return tuple(each for each in done.results if each.fitness is not None)
        self._send_next()
        if self._child and not self._groups and self._memory_limit and (now := monotonic()) >= self._weigh_at:
            self._weigh_at = now + LOOK_INTERVAL
            if (resident_bytes := self._child.memory) > self._memory_limit:
                log.warning("slot %d holds %d MiB; starting another", self.number, resident_bytes >> 20)
                self._restart()
        return done.results

    def _restart(self) -> None:
        self.stop()
        self.start()

    def _replace_child(self) -> tuple[Result, ...]:  # docs/how-to/troubleshooting.md quotes its warning
        """Replace a child that is gone; return errors for the jobs that it was scoring, if it was fresh.

        R8: a crash is an error of these jobs, which other workers then try, and never a fitness. If the child was not
        fresh, the new one scores them first.
        """
        assert self._child is not None  # it has just sent its last event
        steps, failure = self.steps, self._child.close_ended()
        reason = failure.cause if failure.kind == "crash" else failure.text
        running = self.running if self.ready else []  # before it was ready it ran nothing
        if not self._was_ready and failure.kind == "usage":  # another child would say the same
            raise _cannot_start(reason)
        log.warning("slot %d ended (%s)%s; starting another", self.number, reason, describe_jobs(running))
        if not self.ready and failure.kind == "host":
            self._count_starved_start(reason)
            return ()
        if not self.ready:
            self._count_failed_start(reason)
        if running and (self._groups[0].number > 1 or self._groups[0].is_small):
            self._groups.extendleft(reversed(self._groups.popleft().split()))
            self.start()
            return ()
        if running:
            self._groups.popleft()
        self._useless_children += 1
        if self._useless_children < 2:
            self.start()
        else:
            self._clear_child(min(2.0 ** (self._useless_children - 3), MAX_START_DELAY))
        return tuple(Result(job.digest, None, steps // len(running), 0.0, failure, None) for job in running)

    def _count_failed_start(self, reason: str) -> None:
        self._failed_starts += 1
        if self._failed_starts >= FAILED_STARTS:
            raise _cannot_start(reason)

    def _count_starved_start(self, reason: str) -> None:
        """Try again after a growing pause: a host may be short of memory or processes for minutes.

        A slot that was never ready ends soon: its host has too little for it. R20: after some starts the heartbeats do
        not list its jobs any longer, so other slots get them.
        """
        self._starved_starts += 1
        if self._starved_starts >= (STARVED_STARTS if self._was_ready else FAILED_STARTS):
            raise _cannot_start(reason)
        if self._starved_starts >= FAILED_STARTS:
            self._groups.clear()
        self._clear_child(min(START_RETRY_DELAY * 2.0 ** (self._starved_starts - 1), MAX_STARVED_DELAY))

    def _clear_child(self, pause: float) -> None:
        self.ready = self._groups_are_short = False
        self._child_number += 1
        self._child = None
        self._weigh_at = 0.0
        self._start_at = monotonic() + pause

    def start(self) -> None:
        """Start a child and send it the groups that waited for the last one."""
        self._clear_child(0.0)
        number, child_number, events = self.number, self._child_number, self._events
        try:
            if self._failed_starts or self._starved_starts:
                self._restore_bundle()
            self._child = ChildProcess(
                self._arguments, lambda message: events.put(("slot", SlotEvent(number, child_number, message)))
            )
        except (BundleError, OSError, RuntimeError, MemoryError) as error:
            log.warning("slot %d cannot start a process yet: %s", number, error)
            if is_hosts_fault(error):  # no descriptor, process, thread or memory left, no place for a file
                self._count_starved_start(f"{error}; {REMEDY}")
            else:
                self._count_failed_start(str(error) if isinstance(error, BundleError) else f"{error}; {REMEDY}")
                self._clear_child(START_RETRY_DELAY)
            return
        self._child.show(self._is_watched)
        self._watch.restart()
        for group in self._groups:
            group.number = 0
        self._send_next()

    def _send_next(self) -> None:
        """Send the child the next group that waits for it, if the child has none."""
        while self._groups and not self._groups[0].number:
            group = self._groups[0]
            group.work = [work for work in group.work if work[0].digest not in group.unwanted]
            if group.work:
                self._send(group)
            else:
                self._groups.popleft()


def _cannot_start(reason: str) -> DreamfleetError:  # docs/reference/exit-codes.md
    return DreamfleetError(f"a slot cannot start: {reason}; `dreamfleet doctor` looks for the cause")
