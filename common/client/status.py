"""The status of a run as one document: a coordinator's reply under `status`, which every view reads.

It is a consistent snapshot. Long lists are truncated, with their total beside them, so that the reply stays under the
message limit; the parts `workers`, `history`, `evaluations` and `candidates` return them page by page.
"""

import json
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from msgspec import Meta

from dreamfleet.common.client.equal_fitness import describe_equal_fitness
from dreamfleet.common.host.add_ons import find_add_on
from dreamfleet.common.printable import format_number, plural
from dreamfleet.common.protocol.check_counts import CheckCounts
from dreamfleet.common.protocol.failures import describe_job
from dreamfleet.common.protocol.host_classes import HostClasses
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.protocol.messages import MAX_MESSAGE, FleetShare, HostClass
from dreamfleet.common.runs.records import RunSettings, StoredConfirmation, StoredEvaluation, StoredGeneration
from dreamfleet.common.schema.display import Displayed
from dreamfleet.common.schema.validation import (
    OPTIONAL,
    Count,
    MalformedError,
    Moment,
    Seconds,
    Text,
    Word,
    from_plain_lenient,
)

STATUS_SCHEMA_VERSION = 2  # docs/reference/protocol.md has it too
PARTS = ("", "generation", "workers", "history", "evaluations", "candidates", "best", "story")
FINAL_STATES = ("ended", "left")  # the coordinator leaves in these states
LongText = Annotated[str, Meta(max_length=10_000)]


@dataclass(frozen=True)
class EpisodeProgress:
    """Episodes of something in progress."""

    episodes_done: Count
    episodes: Count


@dataclass(frozen=True)
class StageStatus:
    """The current stage of a run's schedule; its settings follow from the run's."""

    number: Count  # from 1
    since: Count  # its first generation


@dataclass(frozen=True)
class GenerationStatus(EpisodeProgress):
    """The generation that is being scored; with racing, half of its episodes are decided later."""

    number: Count
    seconds: Seconds  # in which it could be scored: not paused, and with a worker
    sigma: float  # the optimiser's step size
    temperature: float | None  # of the dream; `None` if the task has none
    stage: StageStatus | None = field(default=None, metadata=OPTIONAL)  # `None` without a schedule
    # Ratio of the longest to the shortest axis of the search distribution; `None` if the optimiser does not report it.
    axis_ratio: float | None = field(default=None, metadata=OPTIONAL)
    failed: Count = field(default=0, metadata=OPTIONAL)  # candidates that failed, those drawn anew included


@dataclass(frozen=True)
class Candidate:
    """One candidate of a generation; its fitness is the mean over its finished episodes."""

    generation: int
    index: int
    done: int
    wanted: int
    fitness: float | None  # `None` before the first episode

    @property
    def has_failed(self) -> bool:
        """Whether an episode failed for good, so that none is wanted any more; live.js counts alike."""
        return self.wanted == 0


@dataclass(frozen=True)
class Population:
    """The candidates of one generation from index `offset` on, of `total`, column by column."""

    generation: Count
    offset: Count
    total: Count
    done: tuple[Count, ...]  # finished episodes
    wanted: tuple[Count, ...]  # episodes known so far
    fitness: tuple[float | None, ...]

    @property
    def has_equal_columns(self) -> bool:
        """Whether its columns have equal lengths."""
        return len(self.done) == len(self.wanted) == len(self.fitness)

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """The candidates as rows."""
        columns = zip(self.done, self.wanted, self.fitness, strict=True)
        return tuple(Candidate(self.generation, index, *row) for index, row in enumerate(columns, self.offset))


@dataclass(frozen=True, repr=False)
class WorkerStatus(Displayed):
    """A worker as the coordinator knows it.

    >>> from dreamfleet import Client
    >>> with Client(address) as client:  # where the coordinator listens
    ...     [worker] = client.workers("cartpole")
    >>> worker.name, worker.state, worker.slots
    ('alpha', 'present', 1)
    """

    worker: Word
    state: Word  # present, silent, lost or left
    slots: Count
    leases: Count
    finished: Count
    steps_per_second: float
    load: float
    drawn_by: Word
    heard: float  # seconds since its last message
    fingerprint: Text
    # Recent seconds of a candidate's job in a slot; `None` before the first.
    job_seconds: float | None = field(default=None, metadata=OPTIONAL)
    # Recent minimum of the seconds until a heartbeat acknowledged a batch: an upper bound of the network's round trip.
    # `None` before the first.
    round_trip: float | None = field(default=None, metadata=OPTIONAL)
    resent: Count = field(default=0, metadata=OPTIONAL)  # batches
    host_class: HostClass = field(default="", metadata=OPTIONAL)  # empty: not known yet
    reason: Text = field(default="", metadata=OPTIONAL)  # why it left

    @property
    def name(self) -> str:
        """The worker's name, which later processes of the same worker share; `worker` is of one process alone."""
        return host_of(self.worker)

    def _display(self) -> tuple[str, dict[str, object]]:
        speed = f"{self.steps_per_second:,.0f} steps/s"
        facts: dict[str, object] = {
            "state": self.state,
            "reason": self.reason or None,
            "slots": self.slots,
            "jobs held": self.leases,
            "jobs finished": self.finished,
            "speed": speed,
            "last heard": f"{self.heard:.1f} s ago",
        }
        slots = plural(self.slots, "slot")
        return (
            f"WorkerStatus of {self.worker}: {self.state}, {slots}, {plural(self.finished, 'job')} finished, {speed}",
            facts,
        )


EventKind = Literal[
    "joined", "back", "silent", "lost", "left", "given", "seen", "sent again", "recalled", "copied", "reissued",
    "accepted", "duplicate", "obsolete", "refused", "failed",
]  # fmt: skip


@dataclass(frozen=True)
class Event:
    """An event of a worker, or of a job that it holds."""

    ago: float  # seconds
    what: EventKind
    worker: Word
    job: Annotated[str, Meta(max_length=128)]  # kind generation/candidate/episode; empty if of no known job
    why: Text = field(default="", metadata=OPTIONAL)  # a worker left, or was refused


@dataclass(frozen=True)
class WorkerCount:
    """Numbers of workers."""

    present: Count
    known: Count  # those that were lost, or left, in the last minutes included
    lost: Count  # in the last minutes, and not back
    left: Count = field(default=0, metadata=OPTIONAL)  # likewise, and they said why


@dataclass(frozen=True)
class Throughput:
    """The fleet's speed and its total work."""

    steps_per_second: float
    environment_steps: Count
    seconds: Seconds  # of closed generations, which a limit of minutes counts
    # At the present workers' speed if they scored nothing else; `None` if unknown.
    episodes_per_second: float | None = field(default=None, metadata=OPTIONAL)  # of candidates
    evaluation_episodes_per_second: float | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class Waste:
    """Work that was repeated or discarded; `share` is that of environment steps."""

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
class ArchiveStatus:
    """What a quality-diversity search has found: the elites, one a cell at most."""

    cells: Count
    filled: Count  # cells that have an elite
    qd_score: float  # the sum of the elites' fitness
    best: float | None  # fitness of the best elite; `None` before the first
    best_cell: tuple[Count, ...]  # its numbers, as `evaluate --cell` takes them

    @property
    def description(self) -> str:
        """The archive in words."""
        filled = f"{self.filled:,} of {self.cells:,} cells filled"
        if self.best is None:
            return filled
        best = f"best elite {format_number(self.best)} (--cell {','.join(map(str, self.best_cell))})"
        return f"{filled}, QD score {format_number(self.qd_score)}, {best}"


@dataclass(frozen=True)
class FailureStatus:
    """An open job that failed on some worker."""

    candidate: Word  # generation/index
    kind: Word
    seeds: tuple[Count, ...]
    errors: dict[str, str]  # the last error of each worker
    attempts: dict[str, int]  # failures of each worker
    retry_in: float | None = field(default=None, metadata=OPTIONAL)  # seconds; `None`: as soon as a slot is free

    @property
    def subject(self) -> str:
        """What the job scores, in words, with its seeds."""
        generation, _, index = self.candidate.partition("/")
        return describe_job(self.kind, generation, index, self.seeds)


@dataclass(frozen=True, repr=False)
class Status(Displayed):
    """A run at one moment.

    >>> from dreamfleet import Client
    >>> with Client(address) as client:  # where the coordinator listens
    ...     status = client.status("cartpole")
    >>> status.settings.population, status.workers.present
    (4, 1)
    """

    schema: Count
    run: Word
    run_uid: Word
    incarnation: Count
    package: Word | None  # version of the coordinator's dreamfleet
    state: Word  # running, evaluating, waiting for workers, waiting for a batch, paused, ended, left
    why: LongText  # reason why it is paused or ended
    settings: RunSettings
    limits: dict[str, Any]
    uptime: Seconds
    generation: GenerationStatus
    generations: Count  # closed ones
    last: StoredGeneration | None
    recent: tuple[StoredGeneration, ...]  # the last closed ones, oldest first
    population: Population  # the first candidates of the open generation
    last_population: Population | None  # the first candidates of the last closed generation
    evaluation: StoredEvaluation | None  # the last one
    best: StoredEvaluation | None  # of all; provisional, as the best of many is partly luck
    evaluations: Count  # finished ones
    evaluating: EpisodeProgress
    collecting: EpisodeProgress
    workers: WorkerCount
    worker_list: tuple[WorkerStatus, ...]  # the first of the known workers
    slots: Count
    fingerprint: Text | None
    throughput: Throughput
    waste: Waste
    failing: Count  # open jobs that failed on some worker
    failures: tuple[FailureStatus, ...]  # the first of these
    dropped: dict[str, int]  # messages, by reason
    refused: dict[str, str] = field(default_factory=dict, metadata=OPTIONAL)  # workers that could not join: reason
    confirmed: StoredConfirmation | None = field(default=None, metadata=OPTIONAL)  # of the reported mean
    confirming: EpisodeProgress = field(default=EpisodeProgress(0, 0), metadata=OPTIONAL)  # one round of a confirmation
    strict: bool = field(default=False, metadata=OPTIONAL)  # hosts of another class than the first result's are refused
    classes: HostClasses = field(default=HostClasses(), metadata=OPTIONAL)  # of the accepted results
    checks: CheckCounts | None = field(default=None, metadata=OPTIONAL)  # of results that other hosts score again
    # When the coordinator's join file expires, in seconds since 1970; `None` without one.
    expires: Moment | None = field(default=None, metadata=OPTIONAL)

    failed: Count = field(default=0, metadata=OPTIONAL)  # candidates of closed generations that failed
    # Since the run began, by the wall clock: pauses, and time without coordinator or workers, included.
    elapsed: Seconds | None = field(default=None, metadata=OPTIONAL)
    equal: Count = field(default=0, metadata=OPTIONAL)  # last generations in a row whose candidates have one fitness
    # The worst candidate of the last generation is better than the worst of all.
    has_risen: bool = field(default=False, metadata=OPTIONAL)
    open_batches: Count = field(default=0, metadata=OPTIONAL)  # submitted ones that wait or are scored
    ending: bool = field(default=False, metadata=OPTIONAL)  # a limit is reached: only evaluations are left
    # Episodes of evaluations and of the confirmation until the run's end.
    closing: Count = field(default=0, metadata=OPTIONAL)
    share: FleetShare = field(default=1.0, metadata=OPTIONAL)  # of workers that serve several runs
    # Steps after which the environment itself ends an episode; `None`: it has no limit, or none is known.
    episode_limit: Count | None = field(default=None, metadata=OPTIONAL)
    archive: ArchiveStatus | None = field(default=None, metadata=OPTIONAL)  # of a run with `--archive`
    # What paused it (`PauseKind`), the latest first; empty where the journal or differing hosts make it wait.
    pauses: tuple[Word, ...] = field(default=(), metadata=OPTIONAL)
    score_word: Word = field(default="seed", metadata=OPTIONAL)  # what the world calls a scored seed: "track", "game"

    def _display(self) -> tuple[str, dict[str, object]]:
        from dreamfleet.common.client.run_view import LiveRunView

        view = LiveRunView.of_status(self)
        return view.headline, view.facts

    def _repr_html_(self) -> str:
        """The card that notebooks show, where the add-on for it is installed."""
        card = find_add_on("status-card")
        return str(card(self)) if card else super()._repr_html_()

    @property
    def is_over(self) -> bool:
        """Whether the run ended or its coordinator leaves it open."""
        return self.state in FINAL_STATES

    @property
    def equal_fitness(self) -> str:
        """A warning that the candidates of the last generations all have one fitness; empty: they do not."""
        return describe_equal_fitness(self.equal, self.settings.task, has_risen=self.has_risen)

    @property
    def refusals(self) -> list[str]:
        """A sentence on each worker that was refused, as long as the run goes on."""
        return [] if self.is_over else [f"worker {name} was refused: {why}" for name, why in self.refused.items()]


def read_status(document: dict[str, Any]) -> Status:
    """Parse a `status` reply; fields of later versions are ignored.

    `MalformedError` says which version to install if it cannot be read.
    """
    try:
        status = from_plain_lenient(Status, document)
        if not all(each.has_equal_columns for each in (status.population, status.last_population) if each is not None):
            raise MalformedError("columns of other lengths")
        return status
    except MalformedError as error:
        run, schema = document.get("run", "?"), document.get("schema", "?")
        package = document.get("package") or "another version"
        differs = "" if schema == STATUS_SCHEMA_VERSION else f"schema {schema}, not {STATUS_SCHEMA_VERSION}: "
        raise MalformedError(
            f"this version cannot read the status of run {run} ({differs}{error}); install the coordinator's "
            f"dreamfleet ({package}) here"
        ) from error


def read_document(payload: bytes) -> dict[str, Any]:
    """Parse a reply's JSON object; `MalformedError` if it is none."""
    try:
        document = json.loads(payload, parse_int=_parse_count) if len(payload) <= MAX_MESSAGE else None
    except (ValueError, RecursionError):
        document = None
    if not isinstance(document, dict):
        raise MalformedError("the reply for the run is not a status: install the same dreamfleet here and there")
    return document


def _parse_count(digits: str) -> int:
    """Parse an integer of at most 64 bits; a longer one may not fit a float."""
    number = int(digits)
    if abs(number) >= 2**64:
        raise ValueError(digits[:20])
    return number
