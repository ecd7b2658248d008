"""A slot: one scoring child after another, so that a crashed simulator costs one job and not the worker."""

from __future__ import annotations

import logging
import queue
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from dreamfleet.common.errors import BundleError, DreamfleetError
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol.messages import Job, Result, TaskSpec
from dreamfleet.worker.service.child import ChildReady
from dreamfleet.worker.service.child_process import ChildMessage, ChildProcess
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import GroupDone, JobGroup, JobWithVector, ScoringFailure

log = logging.getLogger(__name__)
FAILED_STARTS = 3
MAX_NAME_LENGTH = 100  # characters of who draws, which a task says
START_RETRY_DELAY = 2.0  # seconds until a host that had no room for a child is asked again
REMEDY = "give it fewer --slots, or this host more room (ulimit -n, ulimit -u, memory, the disk of temporary files)"
MAX_START_DELAY = 30.0  # seconds before another child, where one after another ends without having done anything
START_LIMIT = 120.0  # seconds that a child may take to load task and world model; doubled with each that took longer
SHORT_GROUP = 0.25  # seconds: after turns below it the next one already waits in the child
MAX_PIPELINED_BYTES = 64 * 1024  # bytes of vectors that a pipe takes while its child is busy


@dataclass(frozen=True)
class SlotEvent:
    """What a slot tells its worker: a word of the child of that life, or that it is gone."""

    slot: int
    child_number: int
    message: ChildMessage

    @property
    def failure(self) -> ScoringFailure | None:
        """What the child raised: as it started, or in the turn that is over."""
        if isinstance(self.message, GroupDone):
            return self.message.failure
        return self.message if isinstance(self.message, ScoringFailure) else None

    @property
    def upload(self) -> bytes | None:
        """The file that the turn left."""
        return self.message.upload if isinstance(self.message, GroupDone) else None


class Slot:
    """The parent's side of one child, which has one turn in its hands and at most one more waiting."""

    def __init__(
        self,
        number: int,
        spec: TaskSpec,
        bundle: Path | None,
        events: queue.SimpleQueue[tuple[str, Any]],
        allowed_tasks: tuple[str, ...],
        memory_limit: int = 0,
        restore_bundle: Callable[[], object] = lambda: None,
    ) -> None:
        """`allowed_tasks` are the tasks that a run may ask of this worker; `memory_limit` in bytes; 0: none.

        `restore_bundle` makes `bundle` whole again after a child that could not start: others write into the cache.
        """
        self.number = number
        self.ready = False
        self.drawn_by = "-"
        self._spec = spec
        self._bundle = bundle
        self._allowed_tasks = allowed_tasks
        self._events = events
        self._memory_limit = memory_limit
        self._restore_bundle = restore_bundle
        self._groups: deque[JobGroup] = deque()
        self._groups_are_short = False  # the last turn was
        self._progress = (0, 0.0)  # steps, and when they were last seen to grow; while it starts, when that began
        self._child_number = 0
        self._failed_starts = 0
        self._useless_children = 0  # children in a row that ended without a finished turn
        self._start_at = 0.0
        self._child: ChildProcess | None = None  # `None` while it must wait for the next one
        self._kill_reason, self._last_error = "", ""
        self._sent = 0  # turns given to this child
        self._is_watched = False
        self._start()

    @property
    def running(self) -> list[Job]:
        """Jobs of the turn in the child's hands."""
        return self._groups[0].jobs if self._groups else []

    @property
    def waiting(self) -> list[Job]:
        """Jobs that the child has not begun."""
        return [job for group in list(self._groups)[1:] for job in group.jobs]

    @property
    def wanted_digests(self) -> set[bytes]:
        """Digests of all its jobs that are wanted."""
        return {job.digest for group in self._groups for job in group.jobs if job.digest not in group.unwanted}

    @property
    def idle(self) -> bool:
        """Ready, with nothing to do."""
        return self.ready and not self._groups

    @property
    def can_queue_another(self) -> bool:
        """Whether a turn may wait in the child, so that it need not wait for us between short ones."""
        return self.ready and self._groups_are_short and len(self._groups) == 1

    @property
    def steps(self) -> int:
        """Environment steps of the running turn so far, over all of its jobs."""
        return self._child.steps if self._groups and self._child else 0

    @property
    def pid(self) -> int:
        """The child's process id."""
        return self._child.pid if self._child else 0

    def submit(self, work: Sequence[JobWithVector]) -> None:
        """Give the child a turn."""
        assert self._child is not None  # it is idle, or takes more
        self._sent += 1
        group = JobGroup(self._sent, work)
        self._groups.append(group)
        if len(self._groups) == 1:
            self._reset_progress()
        self._child.send(group.number, group.work)

    def show(self, wanted: bool) -> None:
        """Have steps of its turns shown from the next one on, by this child and those after it; or no more."""
        self._is_watched = wanted
        if self._child is not None:
            self._child.show(wanted)

    def find_job(self, child_number: int, frame: SampledFrame) -> JobWithVector | None:
        """The job whose step was shown; `None` of a turn that is none of this child's any more."""
        if child_number != self._child_number or not self._groups or self._groups[0].number != frame.group:
            return None
        work = self._groups[0].work
        return work[frame.episode] if frame.episode < len(work) else None

    def check(self, now: float, gap: float) -> None:
        """Kill a child that hangs in a turn or as it starts; `gap` is how long this host itself stood still.

        Where there is none, start one when its time has come.
        """
        if self._child is None:
            if now >= self._start_at:
                self._start()
            return
        steps, since = self._progress
        since += gap
        if not self.ready:
            limit = START_LIMIT * 2**self._failed_starts
            self._kill_after(limit, now - since, f"no word for {limit:g} s as it started")
        elif self._groups:
            if self.steps != steps:
                since = now
            limit = max(job.stall for job in self.running)
            self._kill_after(limit, now - since, f"no step for {limit:g} s")
        self._progress = (self.steps, since)

    def abandon(self, digest: bytes) -> None:
        """A job is not wanted any more; a turn without a wanted one ends at its next step, if it is not over before."""
        for group in self._groups:
            digests = {job.digest for job in group.jobs}
            group.unwanted |= {digest} & digests
            if group.unwanted == digests and self._child:
                self._child.abandon_group(group.number)

    def handle(self, event: SlotEvent) -> tuple[Result, ...]:
        """Take one of this slot's events; the results of its turn, if that has ended."""
        if event.child_number != self._child_number:
            return ()
        if isinstance(event.message, ChildReady):
            self.ready, self.drawn_by = True, truncate(event.message.drawn_by, MAX_NAME_LENGTH) or "-"
            self._failed_starts = 0
            self._reset_progress()
        elif isinstance(event.message, GroupDone):
            return self._finish_group(event.message)
        elif isinstance(event.message, ScoringFailure):
            self._last_error = event.message.text
        elif not isinstance(event.message, SampledFrame):
            return self._replace_child()
        return ()

    def stop(self) -> None:
        """End the child."""
        self._child_number += 1
        if self._child is not None:
            self._child.close()

    def _reset_progress(self) -> None:
        self._progress = (0, monotonic())

    def _kill_after(self, limit: float, quiet: float, why: str) -> None:
        """Kill a child that has been quiet for longer than `limit` seconds; 0: never."""
        if quiet > limit > 0:
            self._kill_reason = why
            if self._child is not None:
                self._child.kill()

    def _finish_group(self, done: GroupDone) -> tuple[Result, ...]:
        group = self._groups.popleft()
        self._useless_children = 0
        self._groups_are_short = (
            group.size <= MAX_PIPELINED_BYTES
            and bool(done.results)
            and sum(each.seconds for each in done.results) < SHORT_GROUP
        )
        self._reset_progress()
        if self._child and not self._groups and 0 < self._memory_limit < (resident_bytes := self._child.memory):
            log.warning("slot %d holds %d MiB; starting another", self.number, resident_bytes >> 20)
            self.stop()
            self._start()
        return done.results

    def _replace_child(self) -> tuple[Result, ...]:
        """Another child in the place of one that is gone; errors for the jobs that it had in its hands."""
        assert self._child is not None  # it was heard
        if not self._child.wait_for_exit():
            self._kill_reason = self._kill_reason or self._last_error
        steps = self.steps
        ended_by = self._child.close()
        reason = self._kill_reason or ended_by or self._last_error
        if not self.ready:
            self._count_failed_start(reason)
        lost = self._groups.popleft().jobs if self.ready and self._groups else []  # one that starts has begun nothing
        log.warning("slot %d ended (%s)%s; starting another", self.number, reason, _describe_lost_jobs(lost))
        self._start_after_pause()
        return tuple(
            Result(job.digest, None, steps // len(lost), 0.0, f"slot crashed ({reason})", None) for job in lost
        )

    def _count_failed_start(self, reason: str) -> None:
        self._failed_starts += 1
        if self._failed_starts >= FAILED_STARTS:
            raise DreamfleetError(f"a slot cannot start: {reason}; `dreamfleet doctor` looks for the cause")

    def _start_after_pause(self) -> None:
        """At once after a child that did something, ever later after those that did not: no host is kept busy so."""
        self._useless_children += 1
        self._clear_child(
            0.0 if self._useless_children < 2 else min(2.0 ** (self._useless_children - 3), MAX_START_DELAY)
        )
        if self._useless_children < 2:
            self._start()

    def _clear_child(self, pause: float) -> None:
        self.ready = self._groups_are_short = False
        self._child_number += 1
        self._child = None
        self._start_at = monotonic() + pause

    def _start(self) -> None:
        """A new child; what waited for the last one goes to it."""
        self._clear_child(0.0)
        self._kill_reason, self._last_error = "", "the child ended"
        self._sent = 0
        number, child_number, events = self.number, self._child_number, self._events
        try:
            if self._failed_starts:
                self._restore_bundle()
            self._child = ChildProcess(
                self._spec,
                self._bundle,
                self._allowed_tasks,
                lambda message: events.put(("slot", SlotEvent(number, child_number, message))),
            )
        except BundleError as error:
            self._count_failed_start(str(error))
            self._clear_child(START_RETRY_DELAY)
            return
        except (OSError, RuntimeError) as error:  # no descriptor, process, thread or memory left, no place for a file
            self._count_failed_start(f"{error}; {REMEDY}")
            log.warning("slot %d cannot start a process yet: %s", number, error)
            self._clear_child(START_RETRY_DELAY)
            return
        self._child.show(self._is_watched)
        self._reset_progress()
        waiting, self._groups = self._groups, deque()
        for group in waiting:
            if wanted := [work for work in group.work if work[0].digest not in group.unwanted]:
                self.submit(wanted)


def _describe_lost_jobs(jobs: list[Job]) -> str:
    """Which job a crash was in."""
    if not jobs:
        return ""
    first, more = jobs[0], f" and {len(jobs) - 1} more" if len(jobs) > 1 else ""
    return f" in generation {first.generation}, candidate {first.candidate}, seed {first.seeds[0]}{more}"
