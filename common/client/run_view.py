"""A run as people read it, live or stored: every view renders this. No input or output.

Scores are a function's own values. Texts may hold what other hosts sent: a renderer makes them printable.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from dreamfleet.common.artifacts.objective import describe_sign
from dreamfleet.common.client.eta import Eta, estimate_eta
from dreamfleet.common.client.status import EpisodeProgress, StageStatus, Status
from dreamfleet.common.printable import format_duration, format_number, plural
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import DREAM, step_unit
from dreamfleet.common.runs.records import (
    SUBMITTED,
    RunSettings,
    StoredConfirmation,
    StoredEvaluation,
    StoredGeneration,
    count_episodes,
    describe_score,
    format_mean,
    in_values,
)
from dreamfleet.common.runs.stages import describe_limit, describe_steps, stages_of

Judged = StoredEvaluation | StoredConfirmation
NAMED_STATES = ("waiting for workers", "paused", "ended")  # whose descriptions begin with their name


@dataclass(frozen=True)
class RunView:
    """What a stored run and a live one show alike."""

    settings: RunSettings
    last: StoredGeneration | None  # the last closed one
    best: StoredEvaluation | None
    confirmed: StoredConfirmation | None
    word: str  # what a scored seed is called: "track", "game"
    episode_limit: int | None  # steps after which the environment itself ends an episode
    stage: StageStatus | None = None  # the current one of a schedule

    @property
    def task(self) -> TaskSpec:
        """What the run's jobs score."""
        return self.settings.task

    @property
    def stage_settings(self) -> RunSettings:
        """The settings as they are in the current stage of a schedule."""
        stages = stages_of(self.settings)
        return self.settings if self.stage is None else stages[min(self.stage.number, len(stages)) - 1].settings

    @property
    def unit(self) -> str:
        """What a step is called: "steps", or "calls" of a function."""
        return step_unit(self.task.task)

    @property
    def reported(self) -> Judged | None:
        """The score that the run reports: the confirmed one, else its best evaluation."""
        return self.confirmed or self.best

    @property
    def score(self) -> str:
        """The reported score as a sentence."""
        return describe_score(self.reported, self.word)

    def describe(self, found: Judged | None) -> str:
        """A score on a line, such as "875.6 ± 4.7 on 100 fresh tracks (generation 54)"."""
        if found is None:
            return "-"
        seeds = count_episodes(found, f"fresh {self.word}" if isinstance(found, StoredConfirmation) else self.word)
        return f"{format_mean(found)} on {seeds} (generation {found.generation})"

    def caption(self, found: Judged) -> str:
        """What stands beneath a score."""
        kind = "confirmed" if isinstance(found, StoredConfirmation) else "provisional"
        return f"{kind}, generation {found.generation}, {count_episodes(found, self.word)}"

    @property
    def spread(self) -> str:
        """The fitness of the last generation's candidates beside their average."""
        if (last := self.last) is None:
            return ""
        std, worst, best = map(format_number, (last.std, last.worst, last.best))
        return f"standard deviation {std}, {worst} to {best}"

    @property
    def optimiser(self) -> str:
        """The optimiser's name, with the kind of covariance matrix for CMA-ES."""
        settings = self.settings
        return f"CMA-ES, {settings.covariance}" if settings.optimiser == "cma" else settings.optimiser

    @property
    def population(self) -> str:
        """How many candidates a generation has, and how many episodes each."""
        size = self.stage_settings
        own = f"{plural(size.population, 'candidate')}, {plural(size.episodes, 'episode')} each"
        return SUBMITTED if self.settings.is_external else own

    @property
    def steps(self) -> str:
        """The steps of an episode, and where they come from if they are fewer than the horizon."""
        settings, limit = self.stage_settings, self.episode_limit
        horizon, driven = settings.task.horizon, settings.driven
        text = describe_steps(horizon, driven, dreamt=self.task.task == DREAM, limit=limit, word=self.unit)
        return text + describe_limit(horizon, limit)

    @property
    def about(self) -> str:
        """The task with its steps, and what its values mean."""
        return ", ".join(filter(None, (self.task.task, self.steps, describe_sign(self.task.options))))


@dataclass(frozen=True, kw_only=True)
class LiveRunView(RunView):
    """A run by its status at one moment."""

    status: Status

    @classmethod
    def of_status(cls, status: Status, word: str = "") -> LiveRunView:
        """The view of a status; `word` is what a scored seed is called if the status does not know it."""
        task = status.settings.task
        scores = in_values(status.last, task), in_values(status.best, task), in_values(status.confirmed, task)
        word, limit = word or status.score_word, status.episode_limit
        return cls(status.settings, *scores, word, limit, status.generation.stage, status=status)

    @cached_property
    def eta(self) -> Eta:
        """How far the run is, and its estimated end."""
        return estimate_eta(self.status)

    @property
    def state(self) -> str:
        """What the run does now, or waits for; without its name."""
        state, detail = self.status.state, self.detail
        return f"{state}: {detail}" if detail and state in NAMED_STATES else detail or state

    @property
    def detail(self) -> str:
        """The same without the state's own name; empty if that says all."""
        status = self.status
        match status.state:
            case "running":
                return self.progress
            case "evaluating":
                return self._judging
            case "waiting for workers":
                return self._waiting
            case "paused":
                return status.why
            case "ended":
                return f"{status.why or 'stopped'}; {self.score}"
            case "left":
                again = f"`dreamfleet coordinator --resume {status.run}` continues (its log has the full command)"
                return f"its coordinator left; {again}"
        return ""

    @property
    def progress(self) -> str:
        """The open generation and its episodes."""
        now = self.status.generation
        return f"generation {now.number}: {format_episodes(now) if now.episodes else 'all candidates failed'}"

    @property
    def _judging(self) -> str:
        if self.status.confirming.episodes:
            return f"confirming its result: {format_episodes(self.status.confirming)}"
        evaluating = self.status.evaluating
        return f"waiting for an evaluation: {format_episodes(evaluating)}" if evaluating.episodes else "evaluating"

    @property
    def _waiting(self) -> str:
        status = self.status
        if status.refused:
            name, why = next(iter(status.refused.items()))
            return f"{name} was refused: {why}"
        if not status.workers.known and not status.throughput.environment_steps:
            return "none has joined yet"
        left = sorted((each for each in status.worker_list if each.reason), key=lambda each: each.heard)
        last = f"; {left[0].worker} left {format_duration(left[0].heard)} ago: {left[0].reason}" if left else ""
        return f"none is present{f' ({self.departed})' if self.departed else ''}{last}"

    @property
    def summary(self) -> str:
        """The status in one line, for a log; without the run's name."""
        status = self.status
        if status.is_over:
            return self.state
        doing = self._judging if status.state == "evaluating" else status.state
        if (
            status.state != "evaluating"
            and not status.ending
            and (status.generation.episodes or not self.settings.is_external)
        ):  # near the run's end, and without a batch, no generation is scored
            doing = f"{status.state}, {self.progress}"
        failed = f"{plural(self.failed, 'failed candidate')}" if self.failed else ""
        score = f"best mean {format_mean(self.reported)}" if self.reported else "nothing evaluated yet"
        fleet = f"{self.workers} with {self.slots}{f' ({self.departed})' if self.departed else ''}"
        return ", ".join(filter(None, (doing, failed, score, self.speed, fleet, self.eta.description)))

    @property
    def failed(self) -> int:
        """Candidates that failed, those of the open generation included."""
        return self.status.failed + self.status.generation.failed

    @property
    def workers(self) -> str:
        """How many are present."""
        return plural(self.status.workers.present, "worker")

    @property
    def slots(self) -> str:
        """How many slots these have."""
        return plural(self.status.slots, "slot")

    @property
    def departed(self) -> str:
        """The workers that went in the last minutes, such as "1 lost, 2 left"; empty if none did."""
        gone = (self.status.workers.lost, "lost"), (self.status.workers.left, "left")
        return ", ".join(f"{count} {how}" for count, how in gone if count)

    @property
    def speed(self) -> str:
        """The fleet's speed."""
        return f"{self.status.throughput.steps_per_second:,.0f} {self.unit}/s"

    @property
    def worked(self) -> str:
        """The time that was worked, and the time that passed; empty if unknown."""
        if self.status.elapsed is None:
            return ""
        worked = format_duration(self.status.throughput.seconds + self.status.generation.seconds)
        return f"{worked} of work in {format_duration(self.status.elapsed)}"

    @property
    def wasted(self) -> str:
        """The redundant work, and what that is."""
        return f"{self.status.waste.share:.1%} of {self.unit}: their results were not needed"

    @property
    def headline(self) -> str:
        """The status in a REPL."""
        return f"Status of {self.status.run}: {self.status.state}, {self.progress}, {self.workers}"

    @property
    def facts(self) -> dict[str, Any]:
        """The status as a small table."""
        status = self.status
        return {
            "task": self.task.task,
            "state": f"{status.state}: {status.why}" if status.why else status.state,
            "progress": self.progress,
            "last generation's average": None if self.last is None else format_number(self.last.mean),
            "archive": None if status.archive is None else status.archive.description,
            "confirmed" if self.confirmed else "best evaluation": self.reported and format_mean(self.reported),
            "workers": f"{self.workers}, {self.slots}",
            "speed": self.speed,
            "failing jobs": status.failing or None,
        }


def format_episodes(part: EpisodeProgress, noun: str = "episode") -> str:
    """How many episodes of a part are done, each called `noun`."""
    return f"{part.episodes_done:,} of {plural(part.episodes, noun)}"
