"""Why a run ended: what ended it, as a program reads it, and the same in words."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class StopKind(StrEnum):
    """What ends a run."""

    GENERATIONS = "generations"
    STEPS = "steps"
    MINUTES = "minutes"
    TARGET = "target"
    CANDIDATE_TARGET = "candidate_target"
    STAGNATION = "stagnation"
    PARTED = "parted"
    ONE_POINT = "one_point"

    @classmethod
    def parse(cls, text: str | None) -> StopKind | None:
        """The kind that a journal holds; `None` if it holds none that this version knows."""
        return next((each for each in cls if each == text), None)


@dataclass(frozen=True)
class StopReason:
    """Why a run ended; `kind` is `None` if it was something else."""

    kind: StopKind | None
    text: str
