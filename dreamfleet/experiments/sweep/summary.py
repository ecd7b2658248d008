"""The results of sweeps: one mean per setting, over the runs that differ in the seed alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import accumulate, combinations
from pathlib import Path
from statistics import fmean
from typing import Any

from dreamfleet.common.addons.analysis.scored_history import goal_of
from dreamfleet.common.protocol.function_values import fitness_word, is_minimised, value_of
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.runs.run_folder import RunFolder, open_run
from dreamfleet.common.runs.standard_error import format_with_error, standard_error
from dreamfleet.experiments.local.local_run import has_begun
from dreamfleet.experiments.sweep.plan import SweepRun

# What a run may be judged by, the strongest first. A best evaluation is none of them: the best of many is partly luck.
CONFIRMED, LAST_EVALUATION, FITNESS = "confirmed", "last evaluation", "mean fitness of the last generation"


@dataclass(frozen=True)
class CurvePoint:
    """A generation's score, and the environment steps of candidates up to its end."""

    generation: int
    steps: int
    score: float


@dataclass(frozen=True)
class RunResult:
    """What one run of a sweep has reached; `scores` by what judged it."""

    name: str
    setting: str
    ended: bool
    scores: dict[str, float]
    evaluated: tuple[CurvePoint, ...]  # evaluated means
    fitness: tuple[CurvePoint, ...]  # mean fitness of each generation
    task: TaskSpec | None = None

    @property
    def in_values(self) -> RunResult:
        """The same with the values of a minimised function in place of its scores."""
        task = self.task
        if task is None or not is_minimised(task):
            return self

        def own(curve: tuple[CurvePoint, ...]) -> tuple[CurvePoint, ...]:
            return tuple(replace(each, score=value_of(each.score, task)) for each in curve)

        scores = {kind: value_of(score, task) for kind, score in self.scores.items()}
        return replace(self, scores=scores, evaluated=own(self.evaluated), fitness=own(self.fitness))


@dataclass(frozen=True)
class SettingResult:
    """One setting over its finished runs: the mean, and its standard error among runs; `None` of one run."""

    setting: str
    runs: int
    mean: float
    error: float | None

    @property
    def text(self) -> str:
        """The mean with its error."""
        return format_with_error(self.mean, self.error)


def read_results(runs_dir: Path, runs: Sequence[SweepRun]) -> list[RunResult]:
    """The results of all runs that have begun, from their journals."""
    return [read_result(runs_dir, run.name, run.setting) for run in runs if has_begun(runs_dir, run.name)]


def read_result(runs_dir: Path, name: str, setting: str) -> RunResult:
    """What a run has reached, under the name of its setting."""
    with open_run(runs_dir, name) as stored, stored.verified_transaction():
        return _read(stored, setting)


def _read(stored: RunFolder, setting: str) -> RunResult:
    history, confirmed = stored.history(), stored.confirmation()
    steps = list(accumulate(each.steps for each in history))
    until = dict(zip((each.number for each in history), steps, strict=True))
    evaluated = tuple(
        CurvePoint(each.generation, until.get(each.generation, steps[-1] if steps else 0), each.mean)
        for each in stored.evaluations()
    )
    fitness = tuple(CurvePoint(each.number, until[each.number], each.mean) for each in history)
    scores = {
        **({} if confirmed is None else {CONFIRMED: confirmed.mean}),
        **({LAST_EVALUATION: evaluated[-1].score} if evaluated else {}),
        **({FITNESS: fitness[-1].score} if fitness else {}),
    }
    return RunResult(stored.name, setting, stored.ended is not None, scores, evaluated, fitness, stored.spec)


def judged_by(results: Sequence[RunResult]) -> str | None:
    """The strongest score that all finished runs have, so that settings are compared by the same."""
    finished = [each for each in results if each.ended]
    kinds = (CONFIRMED, LAST_EVALUATION, FITNESS)
    return next((kind for kind in kinds if finished and all(kind in each.scores for each in finished)), None)


def word_of(results: Sequence[RunResult]) -> str:
    """What the optimiser is given: a function has values, and no fitness."""
    words = {fitness_word(each.task) for each in results if each.task is not None}
    return words.pop() if len(words) == 1 else "fitness"


def with_goal(text: str, results: Sequence[RunResult]) -> str:
    """A score's name, with its goal if that is to be small."""
    goals = {goal_of(minimised=True) if is_minimised(each.task) else "" for each in results if each.task is not None}
    goal = goals.pop() if len(goals) == 1 else ""
    return f"{text} ({goal})" if goal else text


def means(results: Sequence[RunResult], kind: str) -> list[SettingResult]:
    """Each setting's mean over its finished runs, in the order of the settings."""
    found = []
    for setting in dict.fromkeys(each.setting for each in results):
        scores = [each.scores[kind] for each in results if each.setting == setting and each.ended]
        if scores:
            found.append(SettingResult(setting, len(scores), fmean(scores), standard_error(scores)))
    return found


def find_equal(results: Sequence[RunResult], kind: str) -> list[str]:
    """A sentence for each two settings of which every run gave what the other setting's run gave."""
    runs: dict[str, list[RunResult]] = {}
    for each in results:
        if each.ended:
            runs.setdefault(each.setting, []).append(each)
    found: list[str] = []
    for (first, ones), (second, others) in combinations(runs.items(), 2):
        if [each.fitness for each in ones] == [each.fitness for each in others]:
            found.append(f"{first} and {second}: each generation is identical, so what differs changed nothing")
        elif [each.scores[kind] for each in ones] == [each.scores[kind] for each in others]:
            found.append(f"{first} and {second}: identical scores, so this score does not separate them")
    return found


def compare_settings(results: Sequence[RunResult]) -> dict[str, Any]:
    """What settings are judged by, the mean of each, and which are equal, as a JSON document."""
    if (kind := judged_by(results)) is None:
        return {"judged_by": None, "settings": [], "equal": []}
    settings = [asdict(each) for each in means(results, kind)]
    return {"judged_by": kind, "settings": settings, "equal": find_equal(results, kind)}


def mean_curve(curves: Sequence[Sequence[CurvePoint]]) -> list[tuple[float, float, float | None]]:
    """Mean steps, mean score and its standard error at each generation that all curves have."""
    common = set.intersection(*({each.generation for each in curve} for curve in curves)) if curves else set()
    found = []
    for generation in sorted(common):
        points = [each for curve in curves for each in curve if each.generation == generation]
        scores = [each.score for each in points]
        found.append((fmean(each.steps for each in points), fmean(scores), standard_error(scores)))
    return found
