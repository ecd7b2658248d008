"""All scoring slots of a worker, as one."""

from __future__ import annotations

import logging
import queue
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dreamfleet.common.bounds import saturated
from dreamfleet.common.messages import MAX_LEASES, TAG_BYTES, Job, Result, Running, TaskSpec
from dreamfleet.worker.service.announced import check_announced
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.child import Ready
from dreamfleet.worker.service.failures import Failures
from dreamfleet.worker.service.glimpses import Seen
from dreamfleet.worker.service.slot import Slot, SlotEvent
from dreamfleet.worker.service.turn import Work
from dreamfleet.worker.tasks.registry import find_task

log = logging.getLogger(__name__)


class Slots:
    """So many slots that score in one task; `stop` ends their children."""

    def __init__(
        self,
        count: int,
        spec: TaskSpec,
        bundle: Path | None,
        events: queue.SimpleQueue[tuple[str, Any]],
        announced: tuple[str, ...],
        memory_limit: int,
        renew: Callable[[], object] = lambda: None,
    ) -> None:
        """`RefusedError` for a task that is not `announced`; `memory_limit` in bytes a slot; 0: none."""
        check_announced(spec.task, announced)
        self._task = spec.task
        self._width = find_task(spec.task).width
        self._failures = Failures()
        self.host_class = ""  # as the first child found it out; not known before
        self._watched = False
        self._shown: Slot | None = None
        self._slots: list[Slot] = []
        try:
            for number in range(count):
                self._slots.append(Slot(number, spec, bundle, events, announced, memory_limit, renew))
        except BaseException:
            self.stop()  # children that outlived us here would be waited for at the interpreter's end, and wait too
            raise

    def __len__(self) -> int:
        return len(self._slots)

    @property
    def busy(self) -> bool:
        """Whether any scores."""
        return any(slot.running for slot in self._slots)

    @property
    def idle(self) -> bool:
        """Whether any could score and none does."""
        return any(slot.ready for slot in self._slots) and not self.busy

    @property
    def capacity(self) -> int:
        """Jobs that they score at once."""
        return min(sum(slot.ready for slot in self._slots) * self._width, MAX_LEASES // 2)

    @property
    def steps(self) -> int:
        """Environment steps of what runs so far."""
        return sum(slot.steps for slot in self._slots)

    @property
    def running(self) -> list[Running]:
        """Each running job, with its share of its turn's steps."""
        return [
            Running(job.digest[:TAG_BYTES], saturated(slot.steps // len(slot.running)))
            for slot in self._slots
            for job in slot.running
        ]

    @property
    def waiting(self) -> list[Job]:
        """Jobs that lie in a slot and have not begun."""
        return [job for slot in self._slots for job in slot.waiting]

    @property
    def drawn_by(self) -> str:
        """Whose picture they see; `-` where that is not known yet."""
        return next((slot.drawn_by for slot in self._slots if slot.ready), "-")

    def fill(self, backlog: Backlog, undelivered: int) -> None:
        """Take turns from the backlog, unless too many results have no verdict yet: `undelivered`."""
        room = 4 * len(self._slots) * self._width - undelivered
        idle = [slot for slot in self._slots if slot.idle and room >= 0]
        ahead = [slot for slot in self._slots if slot.takes_more and room > 0]
        for slot in idle + ahead:
            if work := backlog.take(self._width):
                slot.submit(work)
        if self._watched and self._shown is not None and not self._shown.running:
            self._show_another()

    def show(self, wanted: bool) -> None:
        """Have one of them show its episodes, or none."""
        self._watched = wanted
        if self._shown is not None:
            self._shown.show(False)
            self._shown = None
        if wanted:
            self._show_another()

    def work_of(self, number: int, life: int, seen: Seen) -> Work | None:
        """The job of which a slot showed a step; `None` of one that is over."""
        return self._slots[number].work_of(life, seen)

    def handle(self, event: SlotEvent) -> tuple[Result, ...]:
        """Take a slot's event; the results that it brings."""
        slot = self._slots[event.slot]
        if isinstance(event.word, Ready):
            self.host_class = self.host_class or event.word.host_class
        if event.failure is not None:
            # A child that is starting has begun nothing, so no job is to blame.
            text = self._failures.tell(event.failure, self._task, slot.running if slot.ready else ())
            if text is not None:
                log.error("%s", text)
        return slot.handle(event)

    def check(self, now: float, gap: float) -> None:
        """Kill what hangs; `gap` is how long this host itself stood still before `now`."""
        for slot in self._slots:
            slot.check(now, gap)

    @property
    def held(self) -> set[bytes]:
        """Digests of the jobs that lie in a slot, begun or not, and are wanted."""
        return set().union(*(slot.held for slot in self._slots))

    def abandon(self, digest: bytes) -> None:
        """A job is not wanted any more."""
        for slot in self._slots:
            slot.abandon(digest)

    def hand_back(self) -> None:
        """Give up what has not begun."""
        for job in self.waiting:
            self.abandon(job.digest)

    def stop(self) -> None:
        """End all children."""
        for slot in self._slots:
            slot.stop()

    def _show_another(self) -> None:
        """The first that runs shows its next turns in place of one that rests."""
        another = next((slot for slot in self._slots if slot.running), self._shown or self._slots[0])
        if another is not self._shown:
            if self._shown is not None:
                self._shown.show(False)
            another.show(True)
            self._shown = another
