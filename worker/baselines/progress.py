"""How far a training has come, and its reports of episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.serialization.optional_fields import OPTIONAL
from dreamfleet.common.serialization.validation import Count, Length, MalformedError, from_plain


@dataclass(frozen=True)
class EpisodeRecord:
    """What is kept of an episode."""

    score: float
    steps: Count  # of the environment
    decisions: Count
    epsilon: float
    loss: float | None  # mean of its updates; `None` where nothing is learnt


@dataclass(frozen=True)
class TrainingProgress:
    """Updates and episodes of a training, the first of these that replay holds, and how it learns."""

    update: Count
    oldest: Count
    episodes: Annotated[tuple[EpisodeRecord, ...], Length(0, 10**7)]
    learning: dict[str, Any] = field(default_factory=dict, metadata=OPTIONAL)


def parse_progress(path: Path, plain: Any) -> TrainingProgress:
    """The progress that the checkpoint at `path` keeps; `DatasetError` for what is none."""
    try:
        found = from_plain(TrainingProgress, plain)
        if found.oldest > len(found.episodes):
            raise MalformedError("fewer episodes than it dropped")
    except MalformedError as error:
        raise DatasetError(f"checkpoint {path} is damaged ({error}); delete it or give --new to begin anew") from error
    return found


@dataclass(frozen=True)
class TrainingReport:
    """The episodes up to `episode`, since the last report."""

    episode: int
    mean: float  # score of these episodes, under their share of random choices
    most: float
    epsilon: float  # of the last one
    loss: float | None

    def __str__(self) -> str:
        loss = "nothing learnt yet" if self.loss is None else f"loss {self.loss:.4g}"
        return f"episode {self.episode}: mean {self.mean:.1f}, best {self.most:.1f}, epsilon {self.epsilon:.2f}, {loss}"


def make_reports(records: Sequence[EpisodeRecord], every: int) -> list[TrainingReport]:
    """A report for each whole group of `every` episodes."""
    ends = range(every, len(records) + 1, every)
    return [_report(records[end - every : end], end) for end in ends]


def is_goal_reached(records: Sequence[EpisodeRecord], every: int, goal: float) -> bool:
    """Whether the episodes of a report had a mean score of `goal`."""
    return any(each.mean >= goal for each in make_reports(records, every))


def _report(records: Sequence[EpisodeRecord], episode: int) -> TrainingReport:
    scores = [each.score for each in records]
    losses = [each.loss for each in records if each.loss is not None]
    return TrainingReport(episode, fmean(scores), max(scores), records[-1].epsilon, fmean(losses) if losses else None)
