"""The check of a new run's environment, before the run exists."""

from __future__ import annotations

import logging
from dataclasses import replace

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.cli.task_check import try_task
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.tasks import DREAM
from dreamfleet.coordinator.settings.config import RunConfig

log = logging.getLogger("dreamfleet.coordinator")


def check_environment(config: RunConfig, bundle: Bundle | None, *, strict: bool) -> RunConfig:
    """The configuration with the task's description; `UsageError` if the environment cannot be scored.

    A task with a world model is not checked: its packages need not be on this host.
    """
    task = config.task
    if bundle is not None or task is None:
        if bundle is not None and task not in (None, DREAM, bundle.manifest.task):
            log.info("%s is not checked here, as its runs need a world model: workers name what fails", task)
        return config
    log.info("checking %s: dry runs in child processes make, reset and step it", task)
    found = try_task(task, config.description_options())
    if found.fault:
        raise UsageError(found.fault)
    for text in found.warnings:
        log.warning("%s: %s", task, text)
    if found.varies and strict:
        raise UsageError(f"{task} is not deterministic, so --strict cannot hold: {found.varies}; or leave --strict out")
    if found.varies:
        log.warning("%s is not deterministic, so a recomputed fitness differs: %s", task, found.varies)
    return replace(config, description=found.description)
