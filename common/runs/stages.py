"""The stages of one run: what each is, and which of them a generation is in.

A generation's stage is a pure function of the run's settings and of what is finished before it opens: the generations
before it, and evaluations that are a whole interval old. So a life of the coordinator that is interrupted anywhere goes
on to the bit.
"""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from dreamfleet.common.printable import plural
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.records import STAGE_FIELDS, RunSettings, StageSettings, StoredEvaluation, StoredGeneration


@dataclass(frozen=True)
class Stage:
    """One stage with all that counts in it, whichever stage named it."""

    number: int  # from 1
    horizon: int
    patience: int
    episodes: int
    population: int
    sigma0: float
    racing: bool
    driven: float  # share of a candidate's episodes in a dream
    search: int  # number of the stage that began the search which goes on in this one
    end: StageSettings
    whole: bool = True  # whether the search goes through all parameters, not in the run's subspace

    @property
    def starts_new_search(self) -> bool:
        """Whether it begins the search anew, from the mean that the stage before it came to."""
        return self.search == self.number

    @property
    def end_condition(self) -> str:
        """What ends it, in words."""
        end = self.end
        said = [plural(end.generations, "generation")] if end.generations else []
        said += [f"{end.steps} environment steps"] if end.steps else []
        said += [f"a score of {end.score:g}"] if end.score is not None else []
        return f"until {' or '.join(said)}" if said else "to the end"

    @property
    def description(self) -> str:
        """In words, for people."""
        patience = f", patience {self.patience}" if self.patience else ""
        search = f"a new search with step size {self.sigma0:g}" if self.starts_new_search else "the search goes on"
        raced = ", racing" if self.racing else ""
        driven = ", all driven" if self.driven == 1 else f", {self.driven:.0%} of them driven" if self.driven else ""
        search += "" if self.whole else " in the subspace"
        size = f"{self.population} x {plural(self.episodes, 'episode')}"
        return f"{self.horizon} steps{patience}, {size}{driven}{raced}, {search}"

    @property
    def driven_episodes(self) -> int:
        """How many of a candidate's episodes in a dream are driven in the world that it dreams of: the first ones."""
        return round(self.driven * self.episodes)

    def spec(self, own: TaskSpec) -> TaskSpec:
        """The run's `own` specification under this stage's horizon and patience."""
        return own.with_overrides(horizon=self.horizon, patience=self.patience)


@dataclass(frozen=True)
class BegunStage:
    """A stage that a run has come to."""

    stage: Stage
    since: int  # its first generation
    why: str = ""  # what the stage before it ended by, in words


def stages_of(settings: RunSettings) -> tuple[Stage, ...]:
    """A run's stages in order; of a run without a schedule the one that it is."""
    spec = settings.task
    found = [
        Stage(
            1, spec.horizon, spec.patience, settings.episodes, settings.population, settings.sigma0, settings.racing,
            settings.driven, search=1, end=settings.stages[0].end if settings.stages else StageSettings(),
            whole=not settings.subspace,
        )
    ]  # fmt: skip
    for each in settings.stages[1:]:
        found.append(_next_stage(found[-1], each))
    return tuple(found)


def _next_stage(before: Stage, each: StageSettings) -> Stage:
    named: dict[str, Any] = {name: getattr(before, name) for name in STAGE_FIELDS} | each.overrides
    whole = before.whole or each.whole
    starts_new_search = each.sigma0 is not None or named["population"] != before.population or whole != before.whole
    number = before.number + 1
    return Stage(number, **named, search=number if starts_new_search else before.search, end=each.end, whole=whole)


def begun_stages(
    settings: RunSettings, history: Sequence[StoredGeneration], evaluations: Iterable[StoredEvaluation]
) -> Sequence[BegunStage]:
    """The stages that a run has come to, the one of its open generation last."""
    stages = StageTracker(settings)
    stages.advance_to(len(history), history, {each.generation: each for each in evaluations})
    return stages.begun


def describe_stages(settings: RunSettings, begun: Sequence[BegunStage]) -> dict[str, str]:
    """Each stage of a schedule in words, and when it began, by its name."""
    found = {}
    for stage in stages_of(settings) if settings.stages else ():
        since = f"since generation {begun[stage.number - 1].since}" if stage.number <= len(begun) else "not begun"
        found[f"stage {stage.number}"] = f"{since}, {stage.end_condition}: {stage.description}"
    return found


def describe_steps(horizon: int, driven: float, *, dreamt: bool) -> str:
    """What an episode of a candidate is, in words: its steps, and in a run of dreams where they are made."""
    if not dreamt:
        return f"{horizon} steps"
    if driven in (0, 1):
        return f"{horizon} {'driven' if driven else 'dreamt'} steps"
    return f"{horizon} steps, {driven:.0%} driven"


def join_distinct(values: Iterable[str]) -> str:
    """What counted in one stage after another, in words; what stayed is said once."""
    return ", then ".join(value for value, _ in groupby(values))


def longest_horizon(settings: RunSettings) -> int:
    """Steps of a scored episode at most, in any stage."""
    return max(each.horizon for each in stages_of(settings))


def latest_usable_evaluation(every: int, generation: int) -> int:
    """The last evaluation, by its generation, that anything about `generation` may depend on; negative: none.

    With one after each `every` generations it was scheduled at least so many generations earlier, which is the time
    that driving it may take.
    """
    return (generation // every - 1) * every - 1 if every else -1


class StageTracker:
    """Which stage one generation after another is in; each closed generation and evaluation is looked at once."""

    def __init__(self, settings: RunSettings) -> None:
        self._every = settings.evaluate_every
        self._stages = stages_of(settings)
        self._begun = [BegunStage(self._stages[0], 0)]
        self._seen = 0  # the latest generation that was asked for
        self._steps = 0  # environment steps of the latest stage before it

    def __len__(self) -> int:
        return len(self._stages)

    @property
    def begun(self) -> Sequence[BegunStage]:
        """Those that had begun by the latest generation that was asked for."""
        return self._begun

    def advance_to(
        self, generation: int, history: Sequence[StoredGeneration], finished: Mapping[int, StoredEvaluation]
    ) -> BegunStage:
        """That of `generation`. Ask for generations in rising order.

        `history` holds at least the generations before it, from the first on, and `finished` by generation the
        evaluations that it depends on.
        """
        while self._seen < generation:
            self._seen += 1
            self._steps += sum(each.steps for each in history[self._seen - 1 : self._seen])
            if len(self._begun) < len(self._stages) and (why := self._end_reason(finished)):
                self._begun.append(BegunStage(self._stages[len(self._begun)], self._seen, why))
                self._steps = 0
        return self._begun[-1]

    def stage_of(self, generation: int) -> BegunStage:
        """That of a generation which is not after the latest that was asked for."""
        return self._begun[bisect(self._begun, generation, key=lambda each: each.since) - 1]

    def required_evaluation(self, generation: int) -> int:
        """The evaluation, by its generation, that may begin another stage at `generation`; negative: none.

        `generation` is the one after the latest that was asked for.
        """
        latest, last = self._begun[-1], latest_usable_evaluation(self._every, generation)
        return last if latest.stage.end.score is not None and last >= latest.since else -1

    def _end_reason(self, finished: Mapping[int, StoredEvaluation]) -> str:
        """What the latest stage ends by before generation `_seen`; empty where it goes on."""
        end, since = self._begun[-1].stage.end, self._begun[-1].since
        if end.generations and self._seen - since >= end.generations:
            return plural(self._seen - since, "generation")
        if end.steps and self._steps >= end.steps:
            return f"{self._steps} environment steps"
        found = finished.get(self.required_evaluation(self._seen))
        if found is not None and end.score is not None and found.mean >= end.score:
            return f"the mean of generation {found.generation} reached {found.mean:.1f}"
        return ""
