"""Judging a controller on unseen tracks, in gymnasium's own unmodified environment."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import cache, partial
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
    path = bundle.path if bundle else None
    yield from drive_in_processes(partial(_drive, spec, path, controller.parameters), seeds, jobs)


def drive_in_processes(drive: Callable[[int], Drive], seeds: tuple[int, ...], jobs: int) -> Iterator[Drive]:
    """What `drive`, which must be picklable, makes of each seed, in `jobs` processes; yields each as it ends."""
    pool = ProcessPoolExecutor(min(jobs, len(seeds)), get_context("spawn"), _start_process)
    try:
        for each in as_completed([pool.submit(drive, seed) for seed in seeds]):
            yield each.result()
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


def judged_in(controller: Controller, bundle: Bundle | None) -> tuple[str, str, float | None]:
    """The task of the world that a controller is judged in, this host's fingerprint for it, and its threshold."""
    assignment = Assignment(spec_for(controller, bundle), bundle)
    task = find_task(controller.task)
    reality, packages = task.reality(assignment), task.world_of(assignment).packages
    return reality.name, fingerprint(packages), reality.world_of(assignment).threshold


def _start_process() -> None:
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C reaches the whole group: end without a traceback


def _drive(spec: TaskSpec, bundle: Path | None, parameters: NDArray[np.float32], seed: int) -> Drive:
    return _judge(spec, bundle).drive(parameters, seed)


@cache
def _judge(spec: TaskSpec, bundle: Path | None) -> Judge:
    """One a process, made by its first drive, so that whatever is wrong is that drive's error."""
    return Judge(spec, Bundle.open(bundle, spec.bundle) if bundle else None)
