"""The records in a run's journal as types: settings, results, generations, evaluations, the confirmed score."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Annotated, Any, Literal, TypeVar, cast

from msgspec import Meta
from numpy.typing import NDArray

from dreamfleet.common.artifacts.controller import Controller, ControllerShape
from dreamfleet.common.errors import JournalError
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.failures import Failure, FailureKind
from dreamfleet.common.protocol.function_values import is_minimised, value_of
from dreamfleet.common.protocol.measures import MAX_AXES, MAX_AXIS
from dreamfleet.common.protocol.messages import Horizon, Packages, Patience, Share, TaskSpec
from dreamfleet.common.runs.standard_error import error_from_population_std, error_from_sample_std, format_with_error
from dreamfleet.common.schema.validation import OPTIONAL, Count, MalformedError, added_option, from_plain, to_plain

MAX_STAGES = 32  # of a schedule; statuses contain them too
PopulationSize = Annotated[int, Meta(ge=2, le=10**5)]
EpisodesPerCandidate = Annotated[int, Meta(ge=1, le=10**4)]
ConfirmationEpisodes = Annotated[int, Meta(ge=0, le=10**4)]  # fresh tracks; 0: no confirmation
OnFailure = Literal["worst", "redraw", "pause"]
EXTERNAL = "external"  # the optimiser of a run whose candidates others submit
SUBMITTED = "candidates as others submit them"  # in place of such a run's population
EpisodeCount = Annotated[int, Meta(ge=1, le=2**63 - 1)]  # at least 1: a standard error divides by it
AxisText = Annotated[str, Meta(min_length=1, max_length=MAX_AXIS)]


@dataclass(frozen=True)
class StageSettings:
    """One `[[stage]]` of a schedule: what ends it, and the settings that it changes."""

    # The first of these that is reached ends it. 0 or None: never.
    generations: Count = added_option(0, "generations of the stage")
    steps: Count = added_option(0, "environment steps of the stage")
    score: float | None = added_option(None, "an evaluated score of a mean that was sampled in the stage")
    # None: as in the stage before.
    horizon: Horizon | None = added_option(None, "as --horizon")
    patience: Patience | None = added_option(None, "as --patience")
    episodes: EpisodesPerCandidate | None = added_option(None, "as --episodes")
    population: PopulationSize | None = added_option(None, "as --population; a change begins a new search at the mean")
    sigma0: float | None = added_option(None, "as --sigma0; begins a new search at the mean")
    racing: bool | None = added_option(None, "as --racing")
    driven: Share | None = added_option(None, "as --driven")
    all_parameters: bool = added_option(False, "leave the run's subspace at the mean; needs a sigma0")
    restart: bool = added_option(
        False, "search anew from the run's first mean, unless the stage before reached its score"
    )

    @property
    def overrides(self) -> dict[str, Any]:
        """The settings that it changes, by name."""
        plain = {name: getattr(self, name) for name in STAGE_FIELDS}
        return {name: value for name, value in plain.items() if value is not None}

    @property
    def end(self) -> StageSettings:
        """Its end conditions alone."""
        return StageSettings(self.generations, self.steps, self.score)

    @property
    def has_end(self) -> bool:
        """Whether it has an end condition."""
        return bool(self.generations or self.steps or self.score is not None)


_NO_SETTINGS = ("generations", "steps", "score", "all_parameters", "restart")
STAGE_FIELDS = tuple(each.name for each in fields(StageSettings) if each.name not in _NO_SETTINGS)


@dataclass(frozen=True)
class RunSettings:
    """The settings that are frozen with a run."""

    task: TaskSpec
    controller: ControllerShape
    population: PopulationSize
    episodes: EpisodesPerCandidate
    sigma0: float
    covariance: Literal["diagonal", "full"]
    seed: Count
    evaluate_every: Count  # generations; 0: never
    evaluation_episodes: EpisodesPerCandidate
    # Only the better half of the candidates is scored in the second half of the episodes.
    racing: bool = field(default=False, metadata=OPTIONAL)
    features: Literal["zh", "z"] = field(default="zh", metadata=OPTIONAL)  # inputs of the controller
    collect_every: Count = field(default=0, metadata=OPTIONAL)  # generations; 0: never
    collect_episodes: EpisodesPerCandidate = field(default=1, metadata=OPTIONAL)
    packages: Packages = field(default=NUMERIC_PACKAGES, metadata=OPTIONAL)  # in its fingerprint
    optimiser: str = field(default="cma", metadata=OPTIONAL)  # registered, or module:attribute
    optimiser_options: tuple[str, ...] = field(default=(), metadata=OPTIONAL)  # each as name=value
    # Fresh tracks of the confirmation at the run's end; 0: none.
    confirm_episodes: ConfirmationEpisodes = field(default=0, metadata=OPTIONAL)
    # Share of a candidate's episodes in a dream task that are scored in reality: its first ones.
    driven: Share = field(default=0.0, metadata=OPTIONAL)
    subspace: str = field(default="", metadata=OPTIONAL)  # SHA-256; empty: search all parameters
    # What becomes of a candidate whose episode fails everywhere: it ranks last, it is drawn anew, or the run pauses.
    on_failure: OnFailure = field(default="pause", metadata=OPTIONAL)
    # A schedule. The settings above are its first stage's, which changes none. The last stage has no end.
    stages: Annotated[tuple[StageSettings, ...], Meta(max_length=MAX_STAGES)] = field(default=(), metadata=OPTIONAL)
    # Axes of its archive, each as MEASURE=LOW:HIGH:CELLS; empty: it measures nothing beside fitness.
    archive: Annotated[tuple[AxisText, ...], Meta(max_length=MAX_AXES)] = field(default=(), metadata=OPTIONAL)

    @property
    def is_external(self) -> bool:
        """Whether the run has no search of its own: others submit its candidates in batches."""
        return self.optimiser == EXTERNAL

    def controller_of(self, parameters: NDArray[Any], provenance: dict[str, Any]) -> Controller:
        """A controller of this run with these parameters, which come from there."""
        about = self.task.task, self.task.bundle, provenance, self.task.options, self.task.world_version
        return Controller(self.controller, parameters, *about)

    def to_json(self) -> str:
        """The text in the journal."""
        return json.dumps(to_plain(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> RunSettings:
        """Parse the text of `to_json`; `JournalError` if it is damaged."""
        try:
            return from_plain(cls, json.loads(text))
        except (ValueError, TypeError, MalformedError, RecursionError) as error:
            raise JournalError(
                f"the journal's settings cannot be read ({error}): a newer dreamfleet wrote them, or they are damaged"
            ) from error


@dataclass(frozen=True)
class StoredResult:
    """One accepted result."""

    kind: str
    generation: int
    candidate: int
    episode: int
    seed: int
    fitness: float
    steps: int
    seconds: float
    worker: str
    fingerprint: str
    host_class: str  # of the worker's host
    digest: str  # of its job, hexadecimal: another one if the candidate was drawn anew since


@dataclass(frozen=True)
class StoredEvent:
    """Something that happened to a run, as its coordinator noted it."""

    happened: float  # seconds since 1970, by the coordinator's wall clock
    incarnation: int
    text: str
    what: str = ""  # happened, in a word, such as `paused`, or `leaves` where the coordinator left by itself
    worker: str = ""


@dataclass(frozen=True)
class StoredFailure:
    """An episode that failed in each independent attempt, so that it has no score."""

    kind: str
    generation: int
    candidate: int
    episode: int
    seed: int
    error: str  # of the last attempt
    cause: str  # equal for equal failures
    fault: FailureKind
    workers: str  # where it was tried, comma-separated
    attempts: int
    happened: float  # seconds since 1970
    digest: str  # of its job, hexadecimal

    @property
    def failure(self) -> Failure:
        """The failure of the last attempt."""
        return Failure(self.error, self.cause, self.fault)


@dataclass(frozen=True)
class WorkerEffort:
    """The accepted results of one worker in one generation, of one kind."""

    worker: str
    generation: int
    kind: str  # score, evaluate, collect
    confirming: bool  # of choosing and confirming the reported mean, after the last generation
    results: int
    steps: float
    seconds: float  # of slots


@dataclass(frozen=True)
class StoredCandidate:
    """One candidate: its fitness, and the episodes that it is the mean of, with their effort.

    A generation's steps are the sum of its candidates'. Results of a vector that was discarded, of seeds that were
    replaced and of a candidate that failed are part of the run's effort alone.
    """

    generation: int
    number: int
    fitness: float | None  # `None` while its generation is open, or if it failed
    episodes: int  # 0 if it failed
    steps: int  # an episode of several equal candidates is driven once: its effort is the first one's
    seconds: float  # slot time


@dataclass(frozen=True)
class StoredGeneration:
    """A closed generation: statistics of its candidates' fitness, step size, and effort."""

    number: int
    mean: float
    std: float
    best: float
    worst: float
    sigma: float
    steps: int
    seconds: float
    failed: Count = field(default=0, metadata=OPTIONAL)  # candidates that failed at least once, also before a redraw


@dataclass(frozen=True)
class StoredEvaluation:
    """A finished evaluation of a generation's mean on validation tracks."""

    generation: int
    episodes: EpisodeCount
    mean: float
    std: float  # of the population: `episodes` in the denominator, in every journal and status
    failed: Count = field(default=0, metadata=OPTIONAL)  # further episodes, which have no score

    @property
    def rank(self) -> tuple[int, float]:
        """The greater, the better: a mean over the episodes that are easy enough not to fail would flatter."""
        return -self.failed, self.mean  # as `Journal.finalists` and `Confirmation` choose among means

    @property
    def is_sound(self) -> bool:
        """Whether at least half of its episodes have a score, so that the mean may end a run or a stage."""
        return self.failed <= self.episodes

    @property
    def error(self) -> float | None:
        """Standard error of the mean; `None` for one episode."""
        return error_from_population_std(self.std, self.episodes)


@dataclass(frozen=True)
class StoredConfirmation:
    """The score that a run reports: of `generation`'s mean, on fresh validation tracks.

    Other tracks chose that mean among the evaluated ones, so `mean` is an unbiased estimate of its score and not the
    best of many.
    """

    generation: int
    episodes: EpisodeCount
    mean: float
    std: float  # of the sample: `episodes - 1` in the denominator (docs/how-to/export.md)
    closed: int  # generations closed before the choice, whose evaluated means it considered
    failed: Count = field(default=0, metadata=OPTIONAL)  # further episodes, which have no score

    @property
    def error(self) -> float | None:
        """Standard error of the mean; `None` for one episode."""
        return error_from_sample_std(self.std, self.episodes)

    def covers(self, best: StoredEvaluation | None) -> bool:
        """Whether the choice considered the best evaluated mean; if not, the run has been continued since."""
        return best is None or best.generation < self.closed

    def to_json(self) -> str:
        """The text in the journal."""
        return json.dumps(to_plain(self), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> StoredConfirmation:
        """Parse the text of `to_json`; `JournalError` if it is damaged."""
        try:
            return from_plain(cls, json.loads(text))
        except (ValueError, TypeError, MalformedError) as error:
            raise JournalError(f"the journal's confirmed score is damaged: {error}") from error


Scored = StoredGeneration | StoredEvaluation | StoredConfirmation
S = TypeVar("S", bound=Scored | None)


def best_evaluation(evaluations: Iterable[StoredEvaluation]) -> StoredEvaluation | None:
    """The evaluation of the highest rank, the first of equal ones; `None` if there are none."""
    return max(evaluations, key=lambda each: each.rank, default=None)


def with_error(found: StoredEvaluation | StoredConfirmation) -> dict[str, Any]:
    """The record as a plain dictionary for JSON and tables, with its standard error under `error`."""
    return {**asdict(found), "error": found.error}


def describe_score(found: StoredEvaluation | StoredConfirmation | None, word: str = "seed") -> str:
    """Describe the score of a mean on seeds, each called `word`, and whether it is confirmed or provisional."""
    if found is None:
        return "the last mean; it was not evaluated"
    score = f"generation {found.generation}'s mean scored {format_mean(found)}"
    score += " (standard error)" if found.error is not None else ""
    if isinstance(found, StoredConfirmation):
        seeds = count_episodes(found, f"fresh validation {word}")
        return f"{score} on {seeds}; confirmed: they were not used to choose it"
    judged = count_episodes(found, f"validation {word}")
    return f"{score} on {judged}; provisional: it is the best of all evaluations so far"


def count_episodes(found: StoredEvaluation | StoredConfirmation, noun: str = "episode") -> str:
    """The number of episodes that a score is the mean of, each called `noun`, and of those that failed.

    >>> count_episodes(StoredEvaluation(4, 19, -3.6, 2.5, failed=1), "seed")
    '19 seeds; 1 more episode failed'
    """
    failed = f"; {plural(found.failed, 'more episode')} failed" if found.failed else ""
    return f"{plural(found.episodes, noun)}{failed}"


def format_mean(found: StoredEvaluation | StoredConfirmation) -> str:
    """Format a mean with its standard error, if it has more than one episode."""
    return format_with_error(found.mean, found.error)


def in_values(found: S, task: TaskSpec) -> S:
    """A record with the function's values in place of fitness: `best` is then the smallest one of a minimised one."""
    if found is None or not is_minimised(task):
        return found
    names = ("mean", "best", "worst") if isinstance(found, StoredGeneration) else ("mean",)
    own: dict[str, Any] = {name: value_of(getattr(found, name), task) for name in names}
    return cast(S, replace(found, **own))
