"""Why a run ends: the first limit that is reached as a generation closes. Pure."""

from __future__ import annotations

from dreamfleet.common.printable import plural
from dreamfleet.coordinator.jobs.evaluation import Evaluations
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.settings.config import LimitsConfig


def stop_reason(limits: LimitsConfig, history: History, evaluations: Evaluations) -> str | None:
    """The limit that is reached, in words; `None` while there is none. The cost does not grow with the run."""
    if limits.generations and len(history) >= limits.generations:
        return plural(len(history), "generation")
    if limits.steps and history.steps >= limits.steps:
        return f"{history.steps} environment steps"
    if limits.minutes and history.seconds >= 60 * limits.minutes:
        return plural(limits.minutes, "minute")
    best = evaluations.best
    if limits.target is not None and best is not None and best.mean >= limits.target:
        return f"the mean of generation {best.generation} reached {best.mean:.1f}"
    if best is not None and limits.parted and evaluations.have_fallen_behind(limits.parted):
        return f"the evaluated mean fell behind generation {best.generation}'s"
    return None
