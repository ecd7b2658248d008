"""How a run is, as one document: what a coordinator answers under `status`, and what every view reads.

It is one consistent moment. What may be long comes as its head, with the total beside it, so that the answer stays
under the message limit; the parts `workers`, `history`, `evaluations` and `candidates` give the rest page by page.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from dreamfleet.common.protocol.host_classes import HostClasses
from dreamfleet.common.protocol.messages import MAX_MESSAGE, HostClass
from dreamfleet.common.runs.records import RunSettings, StoredConfirmation, StoredEvaluation, StoredGeneration
from dreamfleet.common.serialization.constraints import Count, Length, Seconds, Text, Word
from dreamfleet.common.serialization.optional_fields import OPTIONAL, known
from dreamfleet.common.serialization.validation import MalformedError, from_plain

STATUS_SCHEMA_VERSION = 2
PARTS = ("", "generation", "workers", "history", "evaluations", "candidates", "best", "story")
FINAL_STATES = ("ended", "left")  # the states in which a coordinator leaves
LongText = Annotated[str, Length(0, 10_000)]


@dataclass(frozen=True)
class EpisodeProgress:
    """Episodes of something in progress."""

    episodes_done: Count
    episodes: Count


@dataclass(frozen=True)
class StageStatus:
    """Where a run is in its schedule, and what counts there."""

    number: Count  # from 1
    total: Count
    since: Count  # its first generation
    horizon: Count
    patience: Count
    population: Count
    episodes: Count
    racing: bool
    driven: float = field(default=0.0, metadata=OPTIONAL)  # share of a candidate's episodes in a dream


@dataclass(frozen=True)
class GenerationStatus:
    """The generation that is being scored."""

    number: Count
    episodes_done: Count
    episodes: Count  # as far as that is known: racing decides on half of them later
    seconds: Seconds  # since it was opened
    sigma: float  # the strategy's step size
    temperature: float | None  # at which it dreams; `None` where a task has none
    stage: StageStatus | None = field(default=None, metadata=OPTIONAL)  # `None` without a schedule
    # The longest axis of the strategy's distribution by the shortest; `None` where the optimiser does not say.
    axis_ratio: float | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class Candidate:
    """One candidate of a generation: its fitness so far is the mean of the episodes that are done."""

    generation: int
    index: int
    done: int
    wanted: int
    fitness: float | None  # `None` before the first episode


@dataclass(frozen=True)
class Population:
    """Candidates of one generation from index `offset` on, of `total`: a column for each property."""

    generation: Count
    offset: Count
    total: Count
    done: tuple[Count, ...]  # episodes
    wanted: tuple[Count, ...]  # episodes, as far as that is known
    fitness: tuple[float | None, ...]

    @property
    def has_equal_columns(self) -> bool:
        """Whether its columns are equally long."""
        return len(self.done) == len(self.wanted) == len(self.fitness)

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """The same, a row for each candidate."""
        columns = zip(self.done, self.wanted, self.fitness, strict=True)
        return tuple(Candidate(self.generation, index, *row) for index, row in enumerate(columns, self.offset))


@dataclass(frozen=True)
class WorkerStatus:
    """What the coordinator believes of one worker."""

    worker: Word
    state: Word  # present, silent or lost
    slots: Count
    leases: Count
    finished: Count
    steps_per_second: float
    load: float
    drawn_by: Word
    heard: float  # seconds ago
    fingerprint: Text
    # Seconds that a candidate's job took a slot of late; `None` before the first.
    job_seconds: float | None = field(default=None, metadata=OPTIONAL)
    # The least of late until it was known that a batch had arrived, in seconds: beats tell it, so that the network's
    # own round trip is shorter. `None` before the first.
    round_trip: float | None = field(default=None, metadata=OPTIONAL)
    resent: Count = field(default=0, metadata=OPTIONAL)  # batches that were sent again
    host_class: HostClass = field(default="", metadata=OPTIONAL)  # not known yet


EventKind = Literal[
    "joined", "back", "silent", "lost", "left", "given", "seen", "sent again", "recalled", "copied", "reissued",
    "accepted", "duplicate", "obsolete", "refused",
]  # fmt: skip


@dataclass(frozen=True)
class Event:
    """Something that happened to a worker, or to a job in its hands."""

    ago: float  # seconds
    what: EventKind
    worker: Word
    job: Annotated[str, Length(0, 128)]  # kind generation/candidate/episode; empty where it is of no job that is known


@dataclass(frozen=True)
class WorkerCount:
    """How many workers there are."""

    present: Count
    known: Count  # the lost ones too
    # Vanished without a word in the last minutes, and not back. `None` from a coordinator that forgets them at once.
    lost: Count | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class Throughput:
    """How fast the fleet is, and what it has done."""

    steps_per_second: float
    environment_steps: Count
    # Of closed generations: what a limit of minutes counts. `None` from a coordinator of before this.
    seconds: Seconds | None = field(default=None, metadata=OPTIONAL)
    # At the present workers' speed, if they drove nothing else; `None` before it is known.
    episodes_per_second: float | None = field(default=None, metadata=OPTIONAL)  # of candidates
    evaluation_episodes_per_second: float | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class Waste:
    """What was done twice or for nothing; `share` is that of environment steps."""

    discarded_steps: Count
    share: float
    reissued: Count
    recalled: Count
    copied: Count
    duplicate: Count
    obsolete: Count
    errors: Count
    resent_batches: Count
    silences: Count


@dataclass(frozen=True)
class FailureStatus:
    """A wanted job that failed somewhere."""

    candidate: Word  # generation/index
    kind: Word
    seeds: tuple[Count, ...]
    errors: dict[str, str]  # the last of each worker
    attempts: dict[str, int]  # how often each worker failed


@dataclass(frozen=True)
class Status:
    """A run at one moment."""

    schema: Count
    run: Word
    run_uid: Word
    incarnation: Count
    package: Word | None  # version of the coordinator's dreamfleet
    state: Word  # running, evaluating, waiting for workers, paused, ended, left
    why: LongText  # it is paused, or ended
    settings: RunSettings
    limits: dict[str, Any]
    uptime: Seconds
    generation: GenerationStatus
    generations: Count  # closed ones
    last: StoredGeneration | None
    recent: tuple[StoredGeneration, ...]  # the last of the closed ones, oldest first
    population: Population  # the head of the open generation's candidates
    last_population: Population | None  # the head of those of the one that was closed last
    evaluation: StoredEvaluation | None  # the last one
    best: StoredEvaluation | None  # of all; provisional, for the best of many looks is in part luck
    evaluations: Count  # finished ones
    evaluating: EpisodeProgress
    collecting: EpisodeProgress
    workers: WorkerCount
    worker_list: tuple[WorkerStatus, ...]  # the first of those that are known
    slots: Count
    fingerprint: Text | None
    throughput: Throughput
    waste: Waste
    failing: Count  # wanted jobs that failed somewhere
    failures: tuple[FailureStatus, ...]  # the first of them
    dropped: dict[str, int]  # messages, by reason
    refused: dict[str, str] = field(default_factory=dict, metadata=OPTIONAL)  # workers that could not join, and why
    confirmed: StoredConfirmation | None = field(default=None, metadata=OPTIONAL)  # of what is reported
    confirming: EpisodeProgress = field(default=EpisodeProgress(0, 0), metadata=OPTIONAL)  # one round of a confirmation
    strict: bool = field(default=False, metadata=OPTIONAL)  # hosts of another class than the first result's are refused
    classes: HostClasses = field(
        default=HostClasses(), metadata=OPTIONAL
    )  # of the hosts that scored, by accepted results
    # When the coordinator's join file ends, in seconds since 1970; `None` where it has none.
    expires: float | None = field(default=None, metadata=OPTIONAL)

    ending: bool = field(default=False, metadata=OPTIONAL)  # a limit is reached: evaluations are all that is waited for
    # Episodes of means that the run's end yet takes: evaluations in progress, the last one, the confirmation.
    closing: Count = field(default=0, metadata=OPTIONAL)

    @property
    def is_over(self) -> bool:
        """Whether its coordinator leaves, because the run ended or was left open."""
        return self.state in FINAL_STATES


def read_status(document: dict[str, Any]) -> Status:
    """The typed form of a `status` answer; what a later version added is ignored.

    `MalformedError` says what to install where it is not understood.
    """
    try:
        status = from_plain(Status, known(Status, document))
        if not all(each.has_equal_columns for each in (status.population, status.last_population) if each is not None):
            raise MalformedError("columns of other lengths")
        return status
    except MalformedError as error:
        run, schema = document.get("run", "?"), document.get("schema", "?")
        package = document.get("package") or "another version"
        raise MalformedError(
            f"run {run} describes its status in words that this version does not know "
            f"(schema {schema}, not {STATUS_SCHEMA_VERSION}: {error}); "
            f"install the coordinator's dreamfleet ({package}) here"
        ) from error


def read_document(payload: bytes) -> dict[str, Any]:
    """The JSON object in an answer; `MalformedError` if it is none."""
    try:
        document = json.loads(payload, parse_int=_parse_count) if len(payload) <= MAX_MESSAGE else None
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict):
        raise MalformedError("what answers for the run is no status: install the same dreamfleet here and there")
    return document


def _parse_count(digits: str) -> int:
    """A number as every other message can hold it; more digits are no count, and no float can be made of them."""
    number = int(digits)
    if abs(number) >= 2**64:
        raise ValueError(digits[:20])
    return number
