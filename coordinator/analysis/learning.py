"""A run's learning curve: what its evaluated means scored, over all that was spent by then."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.runs.effort import START_EFFORT, Effort, parse_start_effort
from dreamfleet.common.runs.records import StoredConfirmation, StoredEvaluation
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.settings.start import total_effort

CAR_RACING = "car-racing"


@dataclass(frozen=True)
class Point:
    """A mean's score on validation tracks, and what had been spent when it was known, the run's start included."""

    effort: Effort
    score: float
    error: float  # standard error of the mean

    @classmethod
    def of(cls, effort: Effort, found: StoredEvaluation | StoredConfirmation) -> Point:
        """Of what the journal holds."""
        return cls(effort, found.mean, found.error)


@dataclass(frozen=True)
class PublishedScore:
    """A published score; `core_hours` where they are known."""

    steps: float
    score: float
    core_hours: float | None = None


@dataclass(frozen=True)
class LearningCurve:
    """One run's: its evaluations, oldest first, and the confirmed score of what it reports, if there is one."""

    name: str
    world: str  # the task of the world that is driven in reality
    points: tuple[Point, ...]
    confirmed: Point | None
    reported: Point | None  # the evaluation of the mean that was confirmed
    total: Effort  # so far, the start's included

    @classmethod
    def of(cls, run: RunFolder) -> LearningCurve:
        """From a journal; `UsageError` where nothing was evaluated yet."""
        points, confirmed, total = tuple(_points(run)), run.confirmation(), total_effort(run)
        if not points:
            raise UsageError(
                f"run {run.name} has no evaluated mean, so there is nothing to draw: wait for the first, or begin runs "
                "with --evaluate-every"
            )
        judged = None if confirmed is None else Point.of(total, confirmed)
        found = (point for point, each in zip(points, run.evaluations(), strict=True)
                 if confirmed is not None and each.generation == confirmed.generation)  # fmt: skip
        return cls(run.name, _world(run), points, judged, next(found, None), total)


# Ha and Schmidhuber's public log of their CarRacing experiment: the evaluated mean on 1024 tracks. Steps are those of
# candidates alone. Of its time the end is known: 1119 hours on 64 cores.
PAPER_SCORES = (
    PublishedScore(2.6e7, 823),
    PublishedScore(1.0e8, 867),
    PublishedScore(7.8e8, 895),
    PublishedScore(1.7e9, 900.5, 1119 * 64),
)


def _points(run: RunFolder) -> Iterator[Point]:
    """Each evaluation, with all that was spent up to the generation whose mean it judged."""
    spent = parse_start_effort(run.fact(START_EFFORT)) or Effort()
    efforts = deque(each for each in run.efforts() if not each.confirming)
    for evaluation in run.evaluations():
        while efforts and efforts[0].generation <= evaluation.generation:
            spent += efforts.popleft().effort
        yield Point.of(spent, evaluation)


def _world(run: RunFolder) -> str:
    """The task that a run is evaluated in: of a dream its world model's."""
    task = run.spec.task
    return Bundle.open(run.bundle_path, run.spec.bundle).manifest.task if task == DREAM else task
