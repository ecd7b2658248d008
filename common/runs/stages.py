"""The stages of a run's schedule, and the stage of each generation.

A generation's stage, and so how its candidates are scored, is a pure function of the run's settings, of the generations
before it, and of evaluations that are at least one interval old. So a run that is interrupted anywhere continues
bit-identically. Pages: protocol.md.
"""

import hashlib
from bisect import bisect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

from dreamfleet.common.printable import format_number, plural
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.records import (
    STAGE_FIELDS,
    RunSettings,
    StageSettings,
    StoredEvaluation,
    StoredGeneration,
    best_evaluation,
)

TASK_FIELDS = ("horizon", "patience")  # of what stages change, the settings of the task


@dataclass(frozen=True)
class Stage:
    """One stage, with the run's settings as they are in it: changed by its own schedule entry and by earlier ones."""

    number: int  # from 1
    settings: RunSettings
    search: int  # number of the stage that started this stage's search
    end: StageSettings
    all_parameters: bool = True  # whether it searches all parameters, not the run's subspace
    restart: bool = False  # whether its search begins at the run's first mean

    @property
    def starts_new_search(self) -> bool:
        """Whether it starts a new search: from the last mean, as a `restart` from the run's first one.

        After restarts it starts from the best evaluated mean of them all.
        """
        return self.search == self.number

    @property
    def end_condition(self) -> str:
        """The end conditions as a text."""
        end = self.end
        parts = [plural(end.generations, "generation")] if end.generations else []
        parts += [f"{end.steps:,} environment steps"] if end.steps else []
        parts += [f"a score of {end.score:g}"] if end.score is not None else []
        return f"until {' or '.join(parts)}" if parts else "to the end"

    @property
    def description(self) -> str:
        """The settings as a text."""
        own, share = self.settings, self.settings.driven
        patience = f", patience {own.task.patience}" if own.task.patience else ""
        anew = "a search from the start" if self.restart else "a new search"
        search = f"{anew} with step size {own.sigma0:g}" if self.starts_new_search else "the search continues"
        raced = ", racing" if own.racing else ""
        driven = ", all driven" if share == 1 else f", {share:.0%} of them driven" if share else ""
        search += "" if self.all_parameters else " in the subspace"
        size = f"{own.population} x {plural(own.episodes, 'episode')}"
        return f"{plural(own.task.horizon, 'step')}{patience}, {size}{driven}{raced}, {search}"

    @property
    def values(self) -> dict[str, Any]:
        """What stages may change, by name, with its values in this one."""
        own = self.settings
        return {name: getattr(own.task if name in TASK_FIELDS else own, name) for name in STAGE_FIELDS}

    @property
    def driven_episodes(self) -> int:
        """The number of a candidate's episodes in a dream task that are scored in reality: its first ones."""
        return round(self.settings.driven * self.settings.episodes)

    def episode_spec(self, episode: int) -> TaskSpec:
        """The specification of one episode of a candidate."""
        return self.settings.task.with_overrides(driven=episode < self.driven_episodes or None)

    def job_digests(self, vectors: Iterable[bytes], seeds: Sequence[int]) -> Iterator[list[bytes]]:
        """The digests of each candidate's jobs, one a seed, from its float32 vector.

        R1: a digest names the vector and the seed, so a result that counts has another one than that of a
        discarded vector or of a replaced seed in the same place.
        """
        texts = [self.episode_spec(each).digest_text("score", (seed,)) for each, seed in enumerate(seeds)]
        for vector in vectors:
            identity = hashlib.sha256(vector).digest()
            yield [hashlib.sha256(identity + text).digest() for text in texts]


@dataclass(frozen=True)
class BegunStage:
    """A stage that a run has reached."""

    stage: Stage
    since: int  # its first generation
    why: str = ""  # the end condition of the stage before that was met
    origin: int | None = None  # its search begins at this generation's evaluated mean; `None`: see `starts_new_search`

    @property
    def beginning(self) -> str:
        """When and where it began, as a text."""
        return f"since generation {self.since}" + ("" if self.origin is None else f" from {self.origin}'s mean")


def stages_of(settings: RunSettings) -> tuple[Stage, ...]:
    """A run's stages in order; a run without a schedule has one."""
    end = settings.stages[0].end if settings.stages else StageSettings()
    found = [Stage(1, settings, search=1, end=end, all_parameters=not settings.subspace)]
    for each in settings.stages[1:]:
        found.append(_next_stage(found[-1], each))
    return tuple(found)


def _next_stage(before: Stage, each: StageSettings) -> Stage:
    task = before.settings.task.with_overrides(each.horizon, each.patience)
    named = {name: value for name, value in each.overrides.items() if name not in TASK_FIELDS}
    settings = replace(before.settings, task=task, **named)
    all_parameters = before.all_parameters or each.all_parameters
    is_other_size = settings.population != before.settings.population
    is_changed = each.sigma0 is not None or is_other_size or all_parameters != before.all_parameters
    number = before.number + 1
    search = number if is_changed or each.restart else before.search
    return Stage(number, settings, search=search, end=each.end, all_parameters=all_parameters, restart=each.restart)


def is_try(stages: Sequence[Stage | StageSettings], number: int) -> bool:
    """Whether this stage is one of several searches of which the best mean counts: a restart, or what it repeats."""
    return any(each.restart for each in stages[number - 1 : number + 1])


def begun_stages(
    settings: RunSettings, history: Sequence[StoredGeneration], evaluations: Iterable[StoredEvaluation]
) -> Sequence[BegunStage]:
    """The stages that a run has reached, up to its open generation's."""
    stages = StageTracker(settings)
    stages.advance_to(len(history), history, {each.generation: each for each in evaluations})
    return stages.begun


def stage_at(
    generation: int, settings: RunSettings, history: Sequence[StoredGeneration],
    evaluations: Iterable[StoredEvaluation],
) -> BegunStage:  # fmt: skip
    """The stage of one `generation`, as `StageTracker` computes it."""
    finished = {each.generation: each for each in evaluations}
    return StageTracker(settings).advance_to(generation, history, finished)


def describe_steps(horizon: int, driven: float, *, dreamt: bool, limit: int | None = None, word: str = "steps") -> str:
    """Describe the steps of a candidate's episodes; in a dream task also the share in reality.

    `limit` is the environment's own, which ends its episodes before a longer horizon; `word` names real steps.

    >>> describe_steps(1000, 0.0, dreamt=False, limit=300)
    '300 steps'
    """
    if not dreamt:
        return plural(min(horizon, limit or horizon), word.removesuffix("s"))
    if driven in (0, 1):
        return plural(horizon, "driven step" if driven else "dreamt step")
    return f"{plural(horizon, 'step')}, {driven:.0%} driven"


def describe_limit(horizon: int, limit: int | None) -> str:
    """Say where the steps come from if they are fewer than the horizon; else empty."""
    return " (the environment's own limit)" if limit and limit < horizon else ""


def join_distinct(values: Iterable[str]) -> str:
    """Join the values of successive stages to a text; repeated values occur once."""
    return ", then ".join(value for value, _ in groupby(values))


def latest_usable_evaluation(every: int, generation: int) -> int:
    """The generation of the last evaluation on which the parameters of `generation` may depend; negative: none.

    With an evaluation after each `every` generations, it began at least `every` generations earlier, so that it has
    time to finish.
    """
    return (generation // every - 1) * every - 1 if every else -1


class StageTracker:
    """Determines the stage of one generation after another, reading each closed generation and evaluation once."""

    def __init__(self, settings: RunSettings) -> None:
        self._every = settings.evaluate_every
        self._stages = stages_of(settings)
        self._begun = [BegunStage(self._stages[0], 0)]
        self._generation = 0  # the latest one requested
        self._steps = 0  # environment steps of the current stage before it
        self._tries_since = 0 if is_try(self._stages, 1) else None  # first generation of searches that restart
        self._best: StoredEvaluation | None = None  # evaluation of their means

    def __len__(self) -> int:
        return len(self._stages)

    @property
    def begun(self) -> Sequence[BegunStage]:
        """The stages that had begun by the latest requested generation."""
        return self._begun

    def advance_to(
        self, generation: int, history: Sequence[StoredGeneration], finished: Mapping[int, StoredEvaluation]
    ) -> BegunStage:
        """The stage of `generation`; request generations in ascending order.

        `history` holds at least all generations before it; `finished`, by generation, at least the evaluations that it
        depends on.
        """
        while self._generation < generation:
            self._generation += 1
            self._steps += sum(each.steps for each in history[self._generation - 1 : self._generation])
            if self._tries_since is not None:
                counted = finished.get(self.required_evaluation(self._generation))
                self._best = best_evaluation(each for each in (self._best, counted) if each is not None)
            if self._begun[-1].stage.number < len(self._stages) and (why := self._end_reason(finished)):
                self._begin(self._next_stage(finished), why)
        return self._begun[-1]

    def stage_of(self, generation: int) -> BegunStage:
        """The stage of a generation up to the latest requested one."""
        return self._begun[bisect(self._begun, generation, key=lambda each: each.since) - 1]

    def required_evaluation(self, generation: int) -> int:
        """The generation of the evaluation that may start another stage at `generation`, or say where; negative: none.

        `generation` must be the one after the latest requested one.
        """
        since = self._begun[-1].since if self._tries_since is None else self._tries_since
        is_scored = self._begun[-1].stage.end.score is not None
        last = latest_usable_evaluation(self._every, generation)
        return last if (is_scored or self._tries_since is not None) and last >= since else -1

    def _begin(self, stage: Stage, why: str) -> None:
        """Begin a stage: a new search after restarts begins at the best mean of them all that was evaluated in time."""
        is_start = stage.starts_new_search and not stage.restart
        origin = self._best.generation if is_start and self._best is not None else None
        if is_start and self._tries_since is not None and self._best is None:
            why += ", from the last mean, because none was evaluated"
        self._begun.append(BegunStage(stage, self._generation, why, origin))
        self._steps = 0
        if not stage.restart:
            self._tries_since, self._best = self._generation if is_try(self._stages, stage.number) else None, None

    def _next_stage(self, finished: Mapping[int, StoredEvaluation]) -> Stage:
        """The stage after the current one; restarts are left out where its score was reached."""
        following = self._stages[self._begun[-1].stage.number :]
        is_reached = self._find_reached(finished) is not None
        return next(each for each in following if not (each.restart and is_reached))

    def _end_reason(self, finished: Mapping[int, StoredEvaluation]) -> str:
        """The end condition of the current stage that is met before `_generation`; empty if none is."""
        end, since = self._begun[-1].stage.end, self._begun[-1].since
        if end.generations and self._generation - since >= end.generations:
            return f"{plural(self._generation - since, 'generation')} of stage {self._begun[-1].stage.number}"
        if end.steps and self._steps >= end.steps:
            return f"{self._steps:,} environment steps of stage {self._begun[-1].stage.number}"
        if (found := self._find_reached(finished)) is not None:
            reached = format_number(value_of(found.mean, self._begun[-1].stage.settings.task))
            return f"the mean of generation {found.generation} reached {reached}"
        return ""

    def _find_reached(self, finished: Mapping[int, StoredEvaluation]) -> StoredEvaluation | None:
        """The evaluation that counts at `_generation`, if it reached the current stage's score."""
        latest, found = self._begun[-1], finished.get(self.required_evaluation(self._generation))
        score = latest.stage.end.score
        if found is None or score is None or found.generation < latest.since:
            return None
        return found if found.mean >= score and found.is_sound else None
