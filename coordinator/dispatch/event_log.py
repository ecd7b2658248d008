"""The latest events of jobs and workers: a bounded log of typed events. Pure: events and a clock in."""

from collections import OrderedDict, deque
from collections.abc import Collection, Iterator, Sequence
from typing import Literal, NamedTuple

from dreamfleet.common.client.status import EventKind
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.protocol.messages import Job

MAX_EVENTS = 32_768  # that are kept: a view copies their list in some 0.1 ms; docs/how-to/watch.md
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


class EventLog:
    """Records events and forgets the oldest (R26: its length is bounded)."""

    def __init__(self) -> None:
        self.now = 0.0  # seconds of the monotonic clock: when the events come that are added next
        self._events: deque[FleetEvent] = deque(maxlen=MAX_EVENTS)
        self._names: OrderedDict[bytes, tuple[str, int, int, int]] = OrderedDict()  # a dict's first is not found fast

    def add_given(self, worker: str, job: Job) -> None:
        """Record that a worker was given a job, and remember the job's name."""
        if job.digest not in self._names and len(self._names) >= MAX_NAMED:
            self._names.popitem(last=False)
        self._names[job.digest] = (job.kind, job.generation, job.candidate, job.episode)
        self.add("given", worker, job.digest)

    def add(self, what: EventKind, worker: str, digest: bytes | None = None, why: str = "") -> None:
        """Record an event of a worker, or of a job that it holds, and the reason if there is one."""
        job = None if digest is None else self._names.get(digest)
        self._events.append(FleetEvent(self.now, what, worker, job, why))

    def view(self) -> tuple[FleetEvent, ...]:
        """The log as it is now, the newest last, for other threads."""
        return tuple(self._events)


def latest(
    events: Sequence[FleetEvent], worker: str = "", job: tuple[int, int] | None = None, kinds: Collection[str] = ()
) -> Iterator[FleetEvent]:
    """Events from the newest to the oldest, filtered by worker or host name, by candidate and by kind."""
    for each in reversed(events):
        is_of_worker = not worker or worker in (each.worker, host_of(each.worker))
        is_of_job = job is None or (each.job is not None and each.job[1:3] == job)
        if is_of_worker and is_of_job and (not kinds or each.what in kinds):
            yield each
