"""How far a training has come, as its checkpoint keeps it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from dreamfleet.common.codec import MalformedError, from_plain
from dreamfleet.common.errors import DatasetError
from dreamfleet.common.fields import OPTIONAL
from dreamfleet.common.messages import Count, Length


@dataclass(frozen=True)
class Driven:
    """What is kept of an episode."""

    score: float
    steps: Count  # of the environment
    decisions: Count
    epsilon: float
    loss: float | None  # mean of its updates; `None` where nothing is learnt


@dataclass(frozen=True)
class Progress:
    """Updates and episodes of a training, the first of these that replay holds, and how it learns."""

    update: Count
    oldest: Count
    episodes: Annotated[tuple[Driven, ...], Length(0, 10**7)]
    learning: dict[str, Any] = field(default_factory=dict, metadata=OPTIONAL)


def progress_of(path: Path, plain: Any) -> Progress:
    """The progress that the checkpoint at `path` keeps; `DatasetError` for what is none."""
    try:
        found = from_plain(Progress, plain)
        if found.oldest > len(found.episodes):
            raise MalformedError("fewer episodes than it dropped")
    except MalformedError as error:
        raise DatasetError(f"checkpoint {path} is damaged ({error}); delete it or give --new to begin anew") from error
    return found
