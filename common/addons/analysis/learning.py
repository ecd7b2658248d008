"""A run's learning curve: the scores of its evaluated means over the effort spent until then."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.function_values import is_minimised
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.effort import Effort
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation
from dreamfleet.common.runs.run_folder import RunFolder


@dataclass(frozen=True)
class Point:
    """A mean's score on validation tracks, and the effort spent until then, including the run's start."""

    effort: Effort
    score: float
    error: float | None  # standard error of the mean; `None` for one episode

    @classmethod
    def of(cls, effort: Effort, found: StoredEvaluation | StoredConfirmation) -> Point:
        """From a row of the journal."""
        return cls(effort, found.mean, found.error)


@dataclass(frozen=True)
class LearningCurve:
    """A run's evaluations, oldest first, and the confirmed score of the mean that it reports."""

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
        points, confirmed, total = tuple(_points(run)), run.confirmation(), run.total_effort()
        if not points:
            raise UsageError(
                f"run {run.name} has no evaluated mean, so there is nothing to draw: wait for the first, or begin runs "
                "with --evaluate-every"
            )
        judged = None if confirmed is None else Point.of(total, confirmed)
        found = (point for point, each in zip(points, run.evaluations(), strict=True)
                 if confirmed is not None and each.generation == confirmed.generation)  # fmt: skip
        return cls(run.name, _world(run), points, judged, next(found, None), total, is_minimised(run.spec))

    @property
    def in_values(self) -> LearningCurve:
        """The same with the values of a minimised function in place of its scores."""
        if not self.minimised:
            return self

        def own(point: Point | None) -> Point | None:
            return None if point is None else replace(point, score=0.0 - point.score)

        points = tuple(replace(each, score=0.0 - each.score) for each in self.points)
        return replace(self, points=points, confirmed=own(self.confirmed), reported=own(self.reported))


def _points(run: RunFolder) -> Iterator[Point]:
    """Each evaluation, with the effort spent up to its generation."""
    spent = run.start_effort()
    efforts = deque(each for each in run.efforts() if not each.confirming)
    for evaluation in run.evaluations():
        while efforts and efforts[0].generation <= evaluation.generation:
            spent += efforts.popleft().effort
        yield Point.of(spent, evaluation)


def _world(run: RunFolder) -> str:
    """The task that a run is evaluated in; for a dream, the task of its world model."""
    task = run.spec.task
    return Bundle.open(run.bundle_path, run.spec.bundle).manifest.task if task == DREAM else task
