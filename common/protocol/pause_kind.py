"""What pauses a run, as a program reads it."""

from __future__ import annotations

from enum import StrEnum


class PauseKind(StrEnum):
    """What pauses a run."""

    BY_HAND = "by_hand"
    DRAINING = "draining"
    DISBANDING = "disbanding"
    FAILED_JOB = "failed_job"
    FAILED_CANDIDATES = "failed_candidates"
    NO_ABLE_HOST = "no_able_host"
