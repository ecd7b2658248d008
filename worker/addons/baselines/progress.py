"""A training's progress, as its checkpoint keeps it, and the reports over groups of episodes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

from msgspec import Meta

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.printable import format_number
from dreamfleet.common.schema.validation import OPTIONAL, Count, MalformedError, from_plain


@dataclass(frozen=True)
class EpisodeRecord:
    """The figures of one driven episode."""

    score: float
    steps: Count  # of the environment
    decisions: Count
    epsilon: float
    loss: float | None  # mean of its updates; `None` without any


@dataclass(frozen=True)
class TrainingProgress:
    """Updates and episodes of a training, the oldest episode in the replay buffer, and the hyperparameters."""

    update: Count
    oldest: Count
    episodes: Annotated[tuple[EpisodeRecord, ...], Meta(max_length=10**7)]
    learning: dict[str, Any] = field(default_factory=dict, metadata=OPTIONAL)


def parse_progress(path: Path, plain: Any) -> TrainingProgress:
    """Parse the progress `plain` of the checkpoint at `path`; `DatasetError` if it is malformed."""
    try:
        found = from_plain(TrainingProgress, plain)
        if found.oldest > len(found.episodes):
            raise MalformedError("fewer episodes than it dropped")
    except MalformedError as error:
        raise DatasetError(f"checkpoint {path} is damaged ({error}); delete it or give --new to start over") from error
    return found


@dataclass(frozen=True)
class TrainingReport:
    """Means over the episodes since the last report, up to number `episode`."""

    episode: int
    mean: float  # score, random choices included
    most: float  # the best score
    epsilon: float  # of the last one
    loss: float | None

    def __str__(self) -> str:
        loss = "nothing learnt yet" if self.loss is None else f"loss {self.loss:.4g}"
        mean, best = format_number(self.mean), format_number(self.most)
        return f"episode {self.episode}: mean {mean}, best {best}, epsilon {self.epsilon:.2f}, {loss}"


def make_reports(records: Sequence[EpisodeRecord], every: int) -> list[TrainingReport]:
    """Return a report for each complete group of `every` episodes."""
    ends = range(every, len(records) + 1, every)
    return [_report(records[end - every : end], end) for end in ends]


def is_goal_reached(records: Sequence[EpisodeRecord], every: int, goal: float) -> bool:
    """Whether the mean score of any report is at least `goal`."""
    return any(each.mean >= goal for each in make_reports(records, every))


def _report(records: Sequence[EpisodeRecord], episode: int) -> TrainingReport:
    scores = [each.score for each in records]
    losses = [each.loss for each in records if each.loss is not None]
    return TrainingReport(episode, fmean(scores), max(scores), records[-1].epsilon, fmean(losses) if losses else None)
