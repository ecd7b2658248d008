"""The latest events of jobs and workers: a bounded log of typed events. Pure: events and a clock in.

Events are kept in blocks that only grow, so a view costs the same however long the log is, and any thread may read it.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Collection, Iterator
from typing import Literal, NamedTuple

from dreamfleet.common.client.status import EventKind
from dreamfleet.common.protocol.messages import Job

BLOCK, BLOCKS = 256, 128  # events in a block, and blocks that are kept
MAX_NAMED = 10_000  # jobs whose names are kept: many more than workers can hold


class FleetEvent(NamedTuple):
    """One event at a moment of the monotonic clock; `job` is kind, generation, candidate and episode, or unknown."""

    at: float
    what: EventKind
    worker: str
    job: tuple[str, int, int, int] | None
    why: str = ""


NoteKind = (
    EventKind
    | Literal[
        "paused", "resumed", "continues", "written", "stage", "next stage", "reseeded", "retried", "given up",
        "barred", "unbarred", "recalled", "differing", "unsteady", "confirming", "unconfirmed", "clock",
    ]
)  # fmt: skip


class Note(NamedTuple):
    """A line for the log and the journal: `what` happened, and to which `worker`, if it is of one."""

    text: str
    what: NoteKind
    worker: str = ""


class EventLogView:
    """The log as it was when the view was taken."""

    def __init__(self, blocks: tuple[list[FleetEvent], ...], last: int) -> None:
        self._blocks = blocks
        self._last = last  # events in the last block, which may grow

    def latest(
        self, worker: str = "", job: tuple[int, int] | None = None, kinds: Collection[str] = ()
    ) -> Iterator[FleetEvent]:
        """Events from the newest to the oldest, filtered by worker or host name, by candidate and by kind."""
        for number, block in enumerate(reversed(self._blocks)):
            for each in reversed(block if number else block[: self._last]):
                if worker and worker not in (each.worker, each.worker.partition("/")[0]):
                    continue
                if kinds and each.what not in kinds:
                    continue
                if job is None or (each.job is not None and each.job[1:3] == job):
                    yield each


class EventLog:
    """Records events and forgets the oldest (R26: its length is bounded)."""

    def __init__(self) -> None:
        self._blocks: deque[list[FleetEvent]] = deque([[]], maxlen=BLOCKS)
        self._names: OrderedDict[bytes, tuple[str, int, int, int]] = OrderedDict()  # a dict's first is not found fast

    def add_given(self, now: float, worker: str, job: Job) -> None:
        """Record that a worker was given a job, and remember the job's name."""
        if job.digest not in self._names and len(self._names) >= MAX_NAMED:
            self._names.popitem(last=False)
        self._names[job.digest] = (job.kind, job.generation, job.candidate, job.episode)
        self.add(now, "given", worker, job.digest)

    def add(self, now: float, what: EventKind, worker: str, digest: bytes | None = None, why: str = "") -> None:
        """Record an event of a worker, or of a job that it holds, and the reason if there is one."""
        if len(self._blocks[-1]) >= BLOCK:
            self._blocks.append([])
        job = None if digest is None else self._names.get(digest)
        self._blocks[-1].append(FleetEvent(now, what, worker, job, why))

    def view(self) -> EventLogView:
        """The log as it is now, for other threads."""
        return EventLogView(tuple(self._blocks), len(self._blocks[-1]))
