"""What a run's journal holds, as types: its settings, results, generations, evaluations, its confirmed score."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from typing import Annotated, Any, Literal

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import JournalError
from dreamfleet.common.host.fingerprint import NUMERIC_PACKAGES
from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.messages import Horizon, Packages, Patience, Share, TaskSpec
from dreamfleet.common.serialization.constraints import Between, Count, Length
from dreamfleet.common.serialization.optional_fields import OPTIONAL, to_dict
from dreamfleet.common.serialization.validation import MalformedError, from_plain

MAX_STAGES = 32  # of a schedule: a status carries them too
PopulationSize = Annotated[int, Between(2, 10**5)]
EpisodesPerCandidate = Annotated[int, Between(1, 10**4)]
ConfirmationEpisodes = Annotated[int, Between(0, 10**4)]  # fresh tracks; 0: no confirmation
EpisodeCount = Annotated[int, Between(1, 2**63 - 1)]  # that a score was taken over: of none there is no error


def stage_option(default: Any, text: str) -> Any:
    """A key of a `[[stage]]`, which is stored only where it differs from its default."""
    return field(default=default, metadata={**OPTIONAL, "help": text})


@dataclass(frozen=True)
class StageSettings:
    """One `[[stage]]` of a schedule: what ends it, and the settings that it changes."""

    # The first of these that is reached ends it. 0 or None: never.
    generations: Count = stage_option(0, "generations of the stage")
    steps: Count = stage_option(0, "environment steps of the stage")
    score: float | None = stage_option(None, "an evaluated score of a mean that was sampled in the stage")
    # None: as in the stage before.
    horizon: Horizon | None = stage_option(None, "as --horizon")
    patience: Patience | None = stage_option(None, "as --patience")
    episodes: EpisodesPerCandidate | None = stage_option(None, "as --episodes")
    population: PopulationSize | None = stage_option(None, "as --population; a change restarts the search at the mean")
    sigma0: float | None = stage_option(None, "as --sigma0; restarts the search at the mean")
    racing: bool | None = stage_option(None, "as --racing")
    driven: Share | None = stage_option(None, "as --driven")
    whole: bool = stage_option(False, "leave the run's subspace at the mean; needs a sigma0")

    @property
    def overrides(self) -> dict[str, Any]:
        """The settings that it changes, by name."""
        plain = {name: getattr(self, name) for name in STAGE_FIELDS}
        return {name: value for name, value in plain.items() if value is not None}

    @property
    def end(self) -> StageSettings:
        """The same without the settings that it changes."""
        return StageSettings(self.generations, self.steps, self.score)

    @property
    def has_end(self) -> bool:
        """Whether anything ends it."""
        return bool(self.generations or self.steps or self.score is not None)


_END = ("generations", "steps", "score")
STAGE_FIELDS = tuple(each.name for each in fields(StageSettings) if each.name not in (*_END, "whole"))


@dataclass(frozen=True)
class RunSettings:
    """What is frozen with a run; a change asks for another run."""

    task: TaskSpec
    controller: ControllerShape
    population: PopulationSize
    episodes: EpisodesPerCandidate
    sigma0: float
    covariance: Literal["diagonal", "full"]
    seed: Count
    evaluate_every: Count  # generations; 0: never
    evaluation_episodes: EpisodesPerCandidate
    # Only the better half of the candidates drives the second half of the episodes.
    racing: bool = field(default=False, metadata=OPTIONAL)
    features: Literal["zh", "z"] = field(default="zh", metadata=OPTIONAL)  # what the controller sees
    collect_every: Count = field(default=0, metadata=OPTIONAL)  # generations; 0: never
    collect_episodes: EpisodesPerCandidate = field(default=1, metadata=OPTIONAL)
    # Only older runs have one: the temperature was multiplied by it when evaluations fell. 1: never.
    heat: float = field(default=1.0, metadata=OPTIONAL)
    packages: Packages = field(default=NUMERIC_PACKAGES, metadata=OPTIONAL)  # whose versions its fingerprint names
    optimiser: str = field(default="cma", metadata=OPTIONAL)  # registered, or module:attribute
    optimiser_options: tuple[str, ...] = field(default=(), metadata=OPTIONAL)  # each as name=value
    # Fresh tracks on which the reported mean is driven as the run ends; 0: never, as in runs from before this.
    confirm_episodes: ConfirmationEpisodes = field(default=0, metadata=OPTIONAL)
    # Of a candidate's episodes in a dream: driven in the world that it dreams of, the first ones.
    driven: Share = field(default=0.0, metadata=OPTIONAL)
    subspace: str = field(default="", metadata=OPTIONAL)  # SHA-256 of the one that the search keeps to; empty: none
    # Of a schedule; all of the above is the first one's, which names nothing itself. The last one has no end.
    stages: Annotated[tuple[StageSettings, ...], Length(0, MAX_STAGES)] = field(default=(), metadata=OPTIONAL)

    def to_json(self) -> str:
        """The text kept in the journal."""
        return json.dumps(to_dict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> RunSettings:
        """Read what `to_json` wrote; `JournalError` if it is damaged."""
        try:
            return from_plain(cls, json.loads(text))
        except (ValueError, TypeError, MalformedError, RecursionError) as error:
            raise JournalError(f"the journal's settings are damaged: {error}") from error


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
    host_class: str  # of the host that scored


@dataclass(frozen=True)
class StoredCandidate:
    """One candidate: what the strategy was told of it, and what its accepted results took."""

    generation: int
    number: int
    fitness: float | None  # `None` while its generation is open
    episodes: int  # that were scored
    steps: int
    seconds: float  # that slots worked


@dataclass(frozen=True)
class StoredGeneration:
    """Statistics of a closed generation over its candidates' fitness."""

    number: int
    mean: float
    std: float
    best: float
    worst: float
    sigma: float
    steps: int
    seconds: float


@dataclass(frozen=True)
class StoredEvaluation:
    """A finished evaluation of a generation's mean on validation tracks."""

    generation: int
    episodes: EpisodeCount
    mean: float
    std: float

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return self.std / math.sqrt(self.episodes)

    def is_clearly_below(self, other: StoredEvaluation) -> bool:
        """Whether it lies below the other one by more than two standard errors of the difference."""
        return other.mean - self.mean > 2 * math.hypot(other.error, self.error)


@dataclass(frozen=True)
class StoredConfirmation:
    """What a run reports as it ends: `generation`'s mean on fresh validation tracks, which took no part in any choice.

    It was chosen among the evaluated means by other tracks. So `mean` is not the best of many looks but one look, and
    its expected value is what the controller is worth.
    """

    generation: int
    episodes: EpisodeCount
    mean: float
    std: float  # of the sample: `episodes - 1` in the denominator
    closed: int  # generations that were closed by then: the evaluations of these were chosen among

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return self.std / math.sqrt(self.episodes)

    def covers(self, best: StoredEvaluation | None) -> bool:
        """Whether the best evaluated mean was among those that were chosen among; else the run went on and is ahead."""
        return best is None or best.generation < self.closed

    def to_json(self) -> str:
        """The text kept in the journal."""
        return json.dumps(asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> StoredConfirmation:
        """Read what `to_json` wrote; `JournalError` if it is damaged."""
        try:
            return from_plain(cls, json.loads(text))
        except (ValueError, TypeError, MalformedError) as error:
            raise JournalError(f"the journal's confirmed score is damaged: {error}") from error


def best_evaluation(evaluations: Iterable[StoredEvaluation]) -> StoredEvaluation | None:
    """The one of the highest mean; of equals the first."""
    return max(evaluations, key=lambda each: each.mean, default=None)


def expand_task_options(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Plain settings as they are shown: the task's options, which are JSON, as a part; the controller's shape once."""
    task = dict(settings.get("task", {}))
    with suppress(ValueError):
        task["options"] = json.loads(task.get("options") or "{}")
    if task.get("controller") == settings.get("controller"):
        task.pop("controller", None)
    return {**settings, "task": task}


def describe_score(found: StoredEvaluation | StoredConfirmation | None) -> str:
    """A mean's score in words, and whether it can be trusted."""
    if found is None:
        return "the last mean; it was not evaluated"
    score = f"generation {found.generation}'s mean scored {format_mean(found)}"
    score += " (standard error)" if found.episodes > 1 else ""
    if isinstance(found, StoredConfirmation):
        seeds = plural(found.episodes, "fresh validation seed")
        return f"{score} on {seeds}; confirmed: they took no part in its choice"
    return f"{score} on {plural(found.episodes, 'validation seed')}; provisional: it is the best of all looks so far"


def format_mean(found: StoredEvaluation | StoredConfirmation) -> str:
    """A mean with its standard error, which a single episode does not have."""
    return f"{found.mean:.1f}" if found.episodes == 1 else f"{found.mean:.1f} ± {found.error:.1f}"
