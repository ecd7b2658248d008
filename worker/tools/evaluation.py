"""Judging a controller on unseen tracks, in gymnasium's own unmodified environment."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.controller import Controller
from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.evaluated import Drive
from dreamfleet.common.fingerprint import fingerprint
from dreamfleet.common.messages import TaskSpec
from dreamfleet.common.threads import pin_thread_pools
from dreamfleet.worker.tasks.api import ENVIRONMENTS_OWN, Assignment
from dreamfleet.worker.tasks.registry import find_task
from dreamfleet.worker.tools.judge import Judge


def evaluate(controller: Controller, bundle: Bundle | None, seeds: tuple[int, ...], jobs: int) -> Iterator[Drive]:
    """Drive one whole episode a seed in `jobs` processes, in this one if it is 1; yields each as it ends."""
    pin_thread_pools()
    spec = spec_for(controller, bundle)
    if jobs == 1:  # here: a script of one's own need not guard its main part
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        judge = Judge(spec, bundle)
        yield from (judge.drive(controller.parameters, seed) for seed in seeds)
        judge.close()
        return
    pool = ProcessPoolExecutor(min(jobs, len(seeds)), get_context("spawn"), _start_process)
    try:
        path = bundle.path if bundle else None
        drives = [pool.submit(_drive, spec, path, controller.parameters, seed) for seed in seeds]
        for drive in as_completed(drives):
            yield drive.result()
    except BrokenProcessPool as error:
        raise DreamfleetError(
            'a process that drove has crashed; in a script of your own call this under `if __name__ == "__main__":` or '
            "with jobs=1; else `dreamfleet doctor` looks for the cause"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def spec_for(controller: Controller, bundle: Bundle | None) -> TaskSpec:
    """What a controller is judged in: whole episodes of its own task."""
    return TaskSpec(
        controller.task, bundle.sha256 if bundle else "", horizon=ENVIRONMENTS_OWN, patience=0,
        controller=controller.shape, options=controller.options, version=controller.version,
    )  # fmt: skip


def judged_in(controller: Controller, bundle: Bundle | None) -> tuple[str, str]:
    """The task of the world that a controller is judged in, and the fingerprint of this host for it."""
    assignment = Assignment(spec_for(controller, bundle), bundle)
    task = find_task(controller.task)
    return task.reality(assignment).name, fingerprint(task.world_of(assignment).packages)


def _start_process() -> None:
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C reaches the whole group: end without a traceback


def _drive(spec: TaskSpec, bundle: Path | None, parameters: NDArray[np.float32], seed: int) -> Drive:
    return _judge(spec, bundle).drive(parameters, seed)


@cache
def _judge(spec: TaskSpec, bundle: Path | None) -> Judge:
    """One a process, made by its first drive, so that whatever is wrong is that drive's error."""
    return Judge(spec, Bundle.open(bundle, spec.bundle) if bundle else None)
