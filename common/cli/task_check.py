"""The check of a task that needs no world model, before a run begins in it: two trials, each in a child process."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

from dreamfleet.common.cli.trial_process import TrialError, TrialProcess
from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol.tasks import Description
from dreamfleet.common.serialization.optional_fields import OPTIONAL
from dreamfleet.common.serialization.validation import from_plain

CHILD = "dreamfleet.worker.scoring.task_check"
STEP_LIMIT = 120.0  # seconds of one step of a trial, such as a reset; as long as a worker's child may take to start
SECOND_TRIAL_LIMIT = 20.0  # seconds of the first trial's episode from which on there is no second trial
TRIAL_LIMIT = 3600.0  # seconds of a whole trial, which may normalise observations in 20 episodes
MAX_ANSWERS = 200  # of one trial; a sound one gives about a dozen
REMEDY = "draw all randomness from self.np_random, which reset(seed=...) seeds, and keep nothing from earlier episodes"


@dataclass
class TaskTrial:
    """What one child process reports."""

    description: Description | None = None
    fault: str = ""  # why the task cannot be scored; empty: it can
    warnings: tuple[str, ...] = ()
    first: str = ""  # digest of the first observation
    episode: str = ""  # digest of the probe episode; empty: the task has none
    repeated: str = ""  # of the same episode, driven once more; empty: it was not
    seconds: float = 0.0  # that the first episode took


@dataclass
class TrialAnswer:
    """What one line of a child says: the step that begins, or what was found so far."""

    step: str | None = field(default=None, metadata=OPTIONAL)  # empty: it normalises
    report: TaskTrial | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class TaskReport:
    """What was found about a task; `fault` says why it cannot be scored."""

    description: Description | None = None
    fault: str = ""
    warnings: tuple[str, ...] = ()
    compared: bool = False  # whether equal episodes were compared
    varies: str = ""  # what differs between them; empty: nothing was found


def try_task(name: str, options: Mapping[str, Any], limit: float = STEP_LIMIT) -> TaskReport:
    """Make the task's environment, drive its probe episode in two processes, and compare.

    No step may take longer than `limit` seconds. `options` are those that the task describes itself by.
    """
    first = _run_trial({"task": name, "options": options, "thorough": True}, limit)
    if first.fault:
        return TaskReport(fault=first.fault)
    warnings, varies, compared = list(first.warnings), "", False
    if not first.episode or first.seconds > SECOND_TRIAL_LIMIT:
        why = "its first steps take too long" if first.episode else "the task has no probe episode"
        warnings.append(f"whether equal seeds give equal episodes was not checked: {why}")
    else:
        second = _run_trial({"task": name, "options": options, "thorough": False}, limit)
        if second.fault:
            warnings.append(f"a second trial failed: {second.fault}")
        compared, varies = True, _find_difference(first, second)
    return TaskReport(first.description, "", tuple(warnings), compared, varies)


def _find_difference(first: TaskTrial, second: TaskTrial) -> str:
    if second.first and first.first != second.first:
        return f"two resets with one seed give different first observations: {REMEDY}"
    if first.repeated and first.repeated != first.episode:
        return f"equal actions after two resets with one seed give different steps: {REMEDY}"
    if second.episode and second.episode != first.episode:
        return f"equal actions after resets with one seed in two processes give different steps: {REMEDY}"
    return ""


def _run_trial(request: Mapping[str, Any], limit: float) -> TaskTrial:
    """Run one child and return its last report; without one the fault says what it was doing as it hung or crashed."""
    name, step, failure = request["task"], "loading it", ""
    trial: TaskTrial | None = None
    until = monotonic() + TRIAL_LIMIT
    with TrialProcess(CHILD, json.dumps({**request, "path": sys.path})) as child:
        try:
            for _ in range(MAX_ANSWERS):
                left = until - monotonic()
                line = child.read_line(min(limit, left) if step else left)
                if line is None:
                    break
                answer = _parse(line)
                trial = answer.report or trial
                step = step if answer.step is None else answer.step
            else:
                raise TrialError("wrote to the pipe of this check")
            failure = child.describe_failure()
        except TrialError as error:
            failure = str(error)
    failure = failure and f"{one_line(step) or 'normalising'} {failure}"
    if trial is None or (trial.description is None and not trial.fault):
        return TaskTrial(fault=f"{name} cannot be scored: {failure or 'the trial ended without a report'}")
    trial.fault = one_line(trial.fault)
    trial.warnings = tuple(one_line(each) for each in (*trial.warnings, failure) if each)
    return trial


def _parse(line: bytes) -> TrialAnswer:
    """A line of a child; `TrialError` if it is malformed, because environments can write to all its pipes."""
    try:
        return from_plain(TrialAnswer, json.loads(line))
    except (ValueError, RecursionError) as error:
        raise TrialError(f"wrote to the pipe of this check, or describes its task with wrong types: {error}") from error
