"""What pauses or ends a run, as a program reads it, and an end in words. Pages: status.md, python.md."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class PauseKind(StrEnum):
    """What pauses a run."""

    BY_HAND = "by_hand"
    DRAINING = "draining"
    DISBANDING = "disbanding"
    FAILED_JOB = "failed_job"
    FAILED_CANDIDATES = "failed_candidates"
    NO_ABLE_HOST = "no_able_host"


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
