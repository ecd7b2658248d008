"""The check of a new run's environment, before the run exists. Pages: tasks.md, unattended.md."""

import hashlib
import json
import logging
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from dreamfleet.common.addons.task_check.task_check import TaskReport, try_task
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.files.locks import open_lock, wait_for_lock
from dreamfleet.common.files.regular_files import path_exists, read_text
from dreamfleet.common.host.reports import WARNING, report
from dreamfleet.common.printable import printable
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.common.schema.validation import MalformedError, from_plain, to_plain
from dreamfleet.coordinator.settings.config import RunConfig

log = logging.getLogger("dreamfleet.coordinator")
CHECKED = "DREAMFLEET_CHECKED"  # the folder in which coordinators of one sweep leave what their checks found
MOST_BYTES = 1 << 20  # of a report


def check_environment(config: RunConfig, bundle: Bundle | None, *, strict: bool) -> RunConfig:
    """The configuration with the task's description; `UsageError` if the environment cannot be scored.

    A task with a world model is not checked: its packages need not be on this host.
    """
    task = config.task
    if bundle is not None or task is None:
        if bundle is not None and task not in (None, DREAM, bundle.manifest.task):
            log.info("%s is not checked here, as its runs need a world model: workers name what fails", task)
        return config
    found = _check_once(task, config.description_options(), config.measures)
    if found.fault:
        raise UsageError(found.fault)
    for text in found.warnings:
        _warn(f"{task}: {text}")
    if found.varies and strict:
        raise UsageError(f"{task} is not deterministic, so --strict cannot hold: {found.varies}; or omit --strict")
    if found.varies:
        _warn(f"{task} is not deterministic, so a recomputed fitness differs: {found.varies}")
    return replace(config, description=found.description)


def _warn(text: str) -> None:
    log.warning("%s", text)
    report(WARNING, printable(text))


def _check_once(task: str, options: Mapping[str, Any], measures: tuple[str, ...]) -> TaskReport:
    """What the check finds, or found for another coordinator of the sweep: one checks, and the others wait for it."""
    if not (folder := os.environ.get(CHECKED)):
        return _check(task, options, measures)
    key = hashlib.sha256(json.dumps([task, options, measures], sort_keys=True).encode()).hexdigest()[:32]
    path = Path(folder) / f"{key}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    with open_lock(path.with_suffix(".lock")) as lock:
        wait_for_lock(lock)
        with suppress(OSError, ValueError, MalformedError):  # a report that cannot be read is made again
            if path_exists(path):
                return from_plain(TaskReport, json.loads(read_text(path, MOST_BYTES)))
        found = _check(task, options, measures)
        if not found.fault:
            with atomic_write(path) as file:
                file.write(json.dumps(to_plain(found)).encode())
    return found


def _check(task: str, options: Mapping[str, Any], measures: tuple[str, ...]) -> TaskReport:
    log.info("checking %s: dry runs in child processes make, reset and step it", task)
    return try_task(task, options, measures=measures)
