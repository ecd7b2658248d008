"""Why a run ends: its limits, or a search that has converged to one point. Pages: status.md, troubleshooting.md."""

import json
from dataclasses import asdict

from dreamfleet.common.printable import format_number, plural
from dreamfleet.common.protocol.function_values import value_of
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.common.protocol.stop_kind import StopKind, StopReason
from dreamfleet.common.protocol.tasks import steps_word
from dreamfleet.common.runs.run_folder import ENDING, STOP_KIND
from dreamfleet.coordinator.jobs.generation import Generation
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.run.background_jobs import BackgroundJobs
from dreamfleet.coordinator.settings.limits import LimitsConfig
from dreamfleet.coordinator.storage.journal import Journal


def find_stop_reason(
    limits: LimitsConfig, history: History, jobs: BackgroundJobs, generation: Generation, task: TaskSpec
) -> StopReason | None:
    """Why the run of `task` ends before `generation` is scored; `None` if it continues.

    It is the first limit that is reached. The cost does not grow with the run.
    """
    if generation.is_one_point:
        text = f"the search has converged: all candidates of generation {generation.number} are equal"
        return StopReason(StopKind.ONE_POINT, text)
    if limits.generations and len(history) >= limits.generations:
        return StopReason(StopKind.GENERATIONS, plural(len(history), "generation"))
    if limits.steps and history.steps >= limits.steps:
        return StopReason(StopKind.STEPS, f"{history.steps} {steps_word(task.task)}")
    if limits.minutes and history.seconds >= 60 * limits.minutes:
        return StopReason(StopKind.MINUTES, f"{plural(limits.minutes, 'minute')} of work")
    best = jobs.evaluations.best
    if limits.candidate_target is not None and history.best is not None and history.best >= limits.candidate_target:
        return StopReason(
            StopKind.CANDIDATE_TARGET, f"a candidate reached {format_number(value_of(history.best, task))}"
        )
    if limits.stagnation and len(history) - history.improved > limits.stagnation:
        than = f"generation {history.improved}'s best by more than {history.least_improvement:.1g}"
        return StopReason(
            StopKind.STAGNATION, f"no candidate beat {than} for {plural(limits.stagnation, 'generation')}"
        )
    if limits.target is not None and best is not None and best.mean >= limits.target and best.is_sound:
        reached = format_number(value_of(best.mean, task))
        return StopReason(StopKind.TARGET, f"the mean of generation {best.generation} reached {reached}")
    if best is not None and limits.parted and jobs.have_fallen_behind(limits.parted):
        return StopReason(StopKind.PARTED, f"the evaluated mean fell behind generation {best.generation}'s")
    return None


def store_reason(journal: Journal, limits: LimitsConfig, reason: StopReason) -> None:
    """Journal the reached limit with all limits: the last evaluations may make it look unreached again."""
    journal.set_fact(ENDING, json.dumps([reason.text, asdict(limits)]))
    journal.set_fact(STOP_KIND, reason.kind or "")


def stored_reason(journal: Journal, limits: LimitsConfig) -> StopReason | None:
    """The limit that an earlier incarnation reached; `None` if this one has other limits."""
    reason, reached = json.loads(journal.fact(ENDING) or "[null, null]")
    return StopReason(StopKind.parse(journal.fact(STOP_KIND)), reason) if reached == asdict(limits) else None
