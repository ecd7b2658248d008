"""A run's learning curve: the scores of its evaluated means over the effort spent until then. Pages: python.md."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.function_values import is_minimised, value_of
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.effort import Effort, GenerationEffort
from dreamfleet.common.runs.records import in_values
from dreamfleet.common.runs.run_folder import RunFolder


@dataclass(frozen=True)
class Point:
    """A mean's score on validation tracks, and the effort spent until then, including the run's start."""

    effort: Effort
    score: float
    error: float | None  # standard error of the mean; `None` for one episode


@dataclass(frozen=True)
class LearningCurve:
    """A run's evaluations, oldest first, and the confirmed score of the mean that it reports.

    Scores are a function's own values.
    """

    name: str
    world: str  # the task of the evaluations
    points: tuple[Point, ...]
    confirmed: Point | None
    reported: Point | None  # the confirmed mean's evaluation
    total: Effort  # so far, including the run's start
    minimised: bool = False  # whether it is of a function whose values are the negated scores

    @classmethod
    def of(cls, run: RunFolder) -> LearningCurve:
        """Read a run's journal; `UsageError` before the first evaluation."""
        points, total = tuple(points_of(run, as_values=True)), run.total_effort()
        confirmed = in_values(run.confirmation(), run.spec)
        if not points:
            raise UsageError(
                f"run {run.name} has no evaluated mean, so there is nothing to draw: wait for the first, or begin runs "
                "with --evaluate-every"
            )
        judged = None if confirmed is None else Point(total, confirmed.mean, confirmed.error)
        found = (point for point, each in zip(points, run.evaluations(), strict=True)
                 if confirmed is not None and each.generation == confirmed.generation)  # fmt: skip
        return cls(run.name, world_of(run), points, judged, next(found, None), total, is_minimised(run.spec))


def points_of(run: RunFolder, *, as_values: bool) -> Iterator[Point]:
    """Each evaluation, with the effort spent up to its generation: a function's own values, or fitness."""
    evaluations = run.evaluations()
    spent = efforts_until([each.generation for each in evaluations], run.start_effort(), run.efforts())
    for until, evaluation in zip(spent, evaluations, strict=True):
        score = value_of(evaluation.mean, run.spec) if as_values else evaluation.mean
        yield Point(until, score, evaluation.error)


def efforts_until(generations: Iterable[int], start: Effort, efforts: Iterable[GenerationEffort]) -> Iterator[Effort]:
    """The total effort after each of these ascending generations, without that of confirmations."""
    left = deque(sorted((each for each in efforts if not each.confirming), key=lambda each: each.generation))
    for generation in generations:
        while left and left[0].generation <= generation:
            start += left.popleft().effort
        yield start


def world_of(run: RunFolder) -> str:
    """The task that a run is evaluated in; for a dream, the task of its world model."""
    task = run.spec.task
    return Bundle.open(run.bundle_path, run.spec.bundle).manifest.task if task == DREAM else task
