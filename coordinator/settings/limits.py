"""When a run ends. Pages: stop-and-resume.md."""

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from dreamfleet.common.cli.bounds import check_bounds
from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError

MOST_OF_A_LIMIT = 2**53  # every float below it is exact
Limit = Annotated[int, Meta(ge=0, le=MOST_OF_A_LIMIT)]


@dataclass(frozen=True)
class LimitsConfig:
    """When a run ends: at the first limit reached; all are checked as a generation ends. 0: no such limit."""

    generations: Limit = option(0, "stop after so many generations")
    steps: Limit = option(0, "stop with the generation that reaches so many environment steps of candidates")
    minutes: Annotated[float, Meta(ge=0, le=MOST_OF_A_LIMIT)] = option(
        0.0,
        "stop with the generation that closes after so many minutes of work: its episodes are finished, and the last "
        "evaluation and the confirmation come on top",
    )
    target: float | None = option(None, "stop when an evaluated mean reaches this score")
    candidate_target: float | None = option(None, "stop when a candidate reaches this score")
    stagnation: Limit = option(0, "stop when no candidate beat the best one before for so many generations")
    parted: Limit = option(0, "stop when so many evaluations in a row fell clearly behind the best one before them")

    def __post_init__(self) -> None:
        check_bounds(self)
        for name, score in (("target", self.target), ("candidate-target", self.candidate_target)):
            if score is not None and not math.isfinite(score):
                raise UsageError(f"--{name} must be a number, not {score}")
