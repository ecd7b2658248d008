"""The check of a task that needs no world model, before a run begins in it: two trials, each in a child process."""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import IO, Any

from dreamfleet.common.host.processes import parent_death_command
from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol.tasks import Description

CHILD = "dreamfleet.worker.scoring.task_check"
STEP_LIMIT = 120.0  # seconds of one step of a trial, such as a reset; as long as a worker's child may take to start
SECOND_TRIAL_LIMIT = 20.0  # seconds of the first trial's episode from which on there is no second trial
MAX_FAULT_CHARS = 300  # of what a crashed child printed last
REMEDY = "draw all randomness from self.np_random, which reset(seed=...) seeds, and keep nothing from earlier episodes"


@dataclass
class TaskTrial:
    """What one child process reports."""

    description: dict[str, Any] = field(default_factory=dict)
    fault: str = ""  # why the task cannot be scored; empty: it can
    warnings: list[str] = field(default_factory=list)
    first: str = ""  # digest of the first observation
    episode: str = ""  # digest of the probe episode; empty: the task has none
    repeated: str = ""  # of the same episode, driven once more; empty: it was not
    seconds: float = 0.0  # that the first episode took


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
    description = {**first.description, "packages": tuple(first.description["packages"])}
    return TaskReport(Description(**description), "", tuple(warnings), compared, varies)


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
    lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
    name, step, trial = request["task"], "loading it", None
    with tempfile.TemporaryFile() as printed:
        child = subprocess.Popen(  # noqa: S603 - our own interpreter and module
            [*parent_death_command(), sys.executable, "-P", "-m", CHILD],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=printed, text=True, start_new_session=True,
        )  # fmt: skip
        reader = threading.Thread(
            target=_read, args=(child, json.dumps({**request, "path": sys.path}), lines), daemon=True
        )
        reader.start()
        try:
            while (line := lines.get(timeout=limit if step else None)) is not None:
                answer = json.loads(line)
                if "report" in answer:
                    trial = TaskTrial(**answer["report"])
                step = answer.get("step", step)
            failure = "" if child.wait() == 0 else f"{step or 'normalising'} {_describe_end(child, printed)}"
        except queue.Empty:
            failure = f"{step} took longer than {limit:g} s"
        finally:
            if child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)  # with a simulator that it may have started
            child.wait()
            reader.join()
            for each in (child.stdin, child.stdout):
                assert each is not None
                each.close()
    if trial is None:
        return TaskTrial(fault=f"{name} cannot be scored: {failure or 'the trial ended without a report'}")
    trial.warnings += [failure] if failure else []
    return trial


def _read(child: subprocess.Popen[str], request: str, lines: queue.SimpleQueue[str | None]) -> None:
    assert child.stdin is not None
    assert child.stdout is not None
    try:
        child.stdin.write(request)
        child.stdin.close()
        for line in child.stdout:
            lines.put(line)
    except (OSError, ValueError):
        pass  # the child is gone
    finally:
        lines.put(None)


def _describe_end(child: subprocess.Popen[str], printed: IO[bytes]) -> str:
    """How the child ended without a report, and what it printed last."""
    code = child.wait()
    how = f"crashed ({signal.Signals(-code).name})" if code < 0 else f"ended the process (exit code {code})"
    printed.seek(0)
    words = [text for line in printed.read().decode(errors="replace").splitlines() if (text := one_line(line))]
    return f"{how}: {words[-1][:MAX_FAULT_CHARS]}" if words else how
