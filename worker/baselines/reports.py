"""What a training tells of its episodes, a few at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from dreamfleet.worker.baselines.progress import Driven


@dataclass(frozen=True)
class Report:
    """The episodes up to `episode`, since the last report."""

    episode: int
    mean: float  # score of these episodes, under their share of random choices
    most: float
    epsilon: float  # of the last one
    loss: float | None

    def __str__(self) -> str:
        loss = "nothing learnt yet" if self.loss is None else f"loss {self.loss:.4g}"
        return f"episode {self.episode}: mean {self.mean:.1f}, best {self.most:.1f}, epsilon {self.epsilon:.2f}, {loss}"


def reports(records: Sequence[Driven], every: int) -> list[Report]:
    """A report for each whole group of `every` episodes."""
    ends = range(every, len(records) + 1, every)
    return [_report(records[end - every : end], end) for end in ends]


def reached(records: Sequence[Driven], every: int, goal: float) -> bool:
    """Whether the episodes of a report had a mean score of `goal`."""
    return any(each.mean >= goal for each in reports(records, every))


def _report(records: Sequence[Driven], episode: int) -> Report:
    scores = [each.score for each in records]
    losses = [each.loss for each in records if each.loss is not None]
    return Report(episode, fmean(scores), max(scores), records[-1].epsilon, fmean(losses) if losses else None)
