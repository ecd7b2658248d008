"""Why a run ends: its limits, or a search that has converged to one point."""

from __future__ import annotations

from dreamfleet.common.printable import format_number, plural
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.tasks import steps_word
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.run.background_jobs import BackgroundJobs
from dreamfleet.coordinator.settings.limits import LimitsConfig


def find_stop_reason(
    limits: LimitsConfig, history: History, jobs: BackgroundJobs, generation: Generation, task: TaskSpec
) -> str | None:
    """Why the run of `task` ends before `generation` is scored, in words; `None` if it continues."""
    if generation.is_one_point:
        converged = f"the search has converged: all candidates of generation {generation.number} are equal"
        return f"{converged}; a run --from it with a larger --sigma0 searches on"
    return _find_reached_limit(limits, history, jobs, task)


def _find_reached_limit(limits: LimitsConfig, history: History, jobs: BackgroundJobs, task: TaskSpec) -> str | None:
    """The first limit that is reached. The cost does not grow with the run."""
    if limits.generations and len(history) >= limits.generations:
        return plural(len(history), "generation")
    if limits.steps and history.steps >= limits.steps:
        return f"{history.steps} {steps_word(task.task)}"
    if limits.minutes and history.seconds >= 60 * limits.minutes:
        return f"{plural(limits.minutes, 'minute')} of work"
    best = jobs.evaluations.best
    if limits.candidate_target is not None and history.best is not None and history.best >= limits.candidate_target:
        return f"a candidate reached {format_number(value_of(history.best, task))}"
    if limits.stagnation and len(history) - history.improved > limits.stagnation:
        than = f"generation {history.improved}'s best by more than {history.least_improvement:.1g}"
        return f"no candidate beat {than} for {plural(limits.stagnation, 'generation')}"
    if limits.target is not None and best is not None and best.mean >= limits.target and best.is_sound:
        return f"the mean of generation {best.generation} reached {format_number(value_of(best.mean, task))}"
    if best is not None and limits.parted and jobs.have_fallen_behind(limits.parted):
        return f"the evaluated mean fell behind generation {best.generation}'s"
    return None
