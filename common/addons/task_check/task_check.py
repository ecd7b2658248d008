"""The check of a task that needs no world model, before a run begins in it: two dry runs, each in a child process.

Pages: unattended.md, troubleshooting.md, determinism.md.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

from dreamfleet.common.addons.task_check.dry_run_process import DryRunError, DryRunProcess
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol.tasks import Description, is_function_task
from dreamfleet.common.schema.validation import OPTIONAL, from_plain

CHILD = "dreamfleet.worker.addons.task_check"
LAST_STEP = "close()"
LEAVE_OPEN = b"o"  # to a child: close no environment
STEP_LIMIT = 120.0  # seconds of one step of a dry run, such as a reset; as long as a worker's child may take to start
SECOND_RUN_LIMIT = 20.0  # seconds of the first dry run's episode from which on there is no second dry run
DRY_RUN_LIMIT = 3600.0  # seconds of a whole dry run, which may normalise observations in 20 episodes
CLOSE_LIMIT = 15.0  # seconds of its close: more than those of worker/tasks/closing.py, which interrupts it
HASH_SEEDS = (13, 32)  # of the two dry runs: of 24 common sets of two to four words, 22 have another order in each
MAX_ANSWERS = 200  # of one dry run; a sound one gives about a dozen
VARYING_FUNCTION = (
    "two calls of the function with equal arguments give different values: let it take a second parameter `seed`, and "
    "draw all randomness from that"
)
REMEDY = "draw all randomness from self.np_random, which reset(seed=...) seeds, and keep nothing from earlier episodes"


@dataclass
class DryRunReport:
    """What one child process reports."""

    description: Description | None = None
    fault: str = ""  # why the task cannot be scored; empty: it can
    warnings: tuple[str, ...] = ()
    first: str = ""  # digest of the first observation
    episode: str = ""  # digest of the probe episode; empty: the task has none
    repeated: str = ""  # of the same episode, driven once more; empty: it was not
    seconds: float = 0.0  # that the first episode took
    close_hangs: bool = False  # its `close` was interrupted


@dataclass
class DryRunAnswer:
    """What one line of a child says: the step that begins, or what was found so far."""

    step: str | None = field(default=None, metadata=OPTIONAL)  # empty: it normalises
    report: DryRunReport | None = field(default=None, metadata=OPTIONAL)


@dataclass(frozen=True)
class TaskReport:
    """What was found about a task; `fault` says why it cannot be scored."""

    description: Description | None = None
    fault: str = ""
    warnings: tuple[str, ...] = ()
    compared: bool = False  # whether equal episodes were compared
    varies: str = ""  # what differs between them; empty: nothing was found


def try_task(
    name: str, options: Mapping[str, Any], limit: float = STEP_LIMIT, measures: Sequence[str] = ()
) -> TaskReport:  # fmt: skip
    """Make the task's environment, drive its probe episode in two processes, and compare.

    No step may take longer than `limit` seconds. `options` are those that the task describes itself by. An
    unknown one of `measures` is a fault.
    """
    request = {"task": name, "options": options, "measures": list(measures), "path": sys.path}

    def start(*, thorough: bool) -> DryRunProcess:
        return DryRunProcess(CHILD, json.dumps({**request, "thorough": thorough}), HASH_SEEDS[not thorough])

    with ExitStack() as stack:
        with start(thorough=True) as child:
            # Where a core is free, the second process loads beside the first dry run, and begins its own after it.
            another = stack.enter_context(start(thorough=False)) if usable_cores() > 1 else None
            first = _dry_run(child, name, limit)
        if first.fault:
            return TaskReport(fault=first.fault)
        warnings, varies, compared = list(first.warnings), "", False
        if not first.episode or first.seconds > SECOND_RUN_LIMIT:
            why = "its first steps take too long" if first.episode else "the task has no probe episode"
            warnings.append(f"whether equal seeds give equal episodes was not checked: {why}")
        else:
            process = another or stack.enter_context(start(thorough=False))
            second = _dry_run(process, name, limit, LEAVE_OPEN if first.close_hangs else b"")
            if second.fault:
                warnings.append(f"a second dry run failed: {second.fault}")
            compared, varies = True, _find_difference(first, second)
            if varies and is_function_task(name):
                varies = VARYING_FUNCTION
    return TaskReport(first.description, "", tuple(dict.fromkeys(warnings)), compared, varies)


def _find_difference(first: DryRunReport, second: DryRunReport) -> str:
    if second.first and first.first != second.first:
        return f"two resets with one seed give different first observations: {REMEDY}"
    if first.repeated and first.repeated != first.episode:
        return f"equal actions after two resets with one seed give different steps: {REMEDY}"
    if second.episode and second.episode != first.episode:
        return f"equal actions after resets with one seed in two processes give different steps: {REMEDY}"
    return ""


def _dry_run(child: DryRunProcess, name: str, limit: float, word: bytes = b"") -> DryRunReport:
    """Let a child begin with this word and return its last report.

    Without one the fault says what it did as it hung or crashed.
    """
    step, failure = "loading it", ""
    report: DryRunReport | None = None
    until = monotonic() + DRY_RUN_LIMIT
    child.begin(word)
    try:
        for _ in range(MAX_ANSWERS):
            left = until - monotonic()
            own = CLOSE_LIMIT if step == LAST_STEP else limit
            line = child.read_line(min(own, left) if step else left)
            if line is None:
                break
            answer = _parse(line)
            report = answer.report or report
            step = step if answer.step is None else answer.step
        else:
            raise DryRunError("wrote to the pipe of this check")
        is_through = report is not None and (bool(report.fault) or step == LAST_STEP)
        failure = "" if is_through and child.exit_code == 0 else child.describe_failure()
    except DryRunError as error:
        failure = str(error)
    failure = failure and f"{one_line(step) or 'normalising'} {failure}"
    if report is None or (report.description is None and not report.fault):
        return DryRunReport(fault=f"{name} cannot be scored: {failure or 'it does not describe itself'}")
    report.fault = one_line(report.fault)
    report.warnings = tuple(one_line(each) for each in (*report.warnings, failure) if each)
    return report


def _parse(line: bytes) -> DryRunAnswer:
    """A line of a child; `DryRunError` if it is malformed, because environments can write to all its pipes."""
    try:
        return from_plain(DryRunAnswer, json.loads(line))
    except (ValueError, RecursionError) as error:
        what = "wrote to the pipe of this check, or describes its task with wrong types"
        raise DryRunError(f"{what}: {error}") from error
