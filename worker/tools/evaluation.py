"""Judging a controller on unseen tracks, in gymnasium's own unmodified environment."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle, BundleStore, default_cache, find_bundle
from dreamfleet.common.controller import Controller
from dreamfleet.common.errors import BundleError, DreamfleetError
from dreamfleet.common.files import is_there
from dreamfleet.common.messages import TaskSpec
from dreamfleet.common.threads import pin_thread_pools
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import ENVIRONMENTS_OWN


@dataclass(frozen=True)
class Evaluated:
    """Scores of whole episodes, one a seed."""

    seeds: tuple[int, ...]
    scores: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean score."""
        return float(np.mean(self.scores))

    @property
    def std(self) -> float:
        """Standard deviation between tracks."""
        return float(np.std(self.scores))


def bundle_for(controller: Controller, named: str | None, beside: Path | None = None) -> Bundle | None:
    """The world model that a controller was evolved with: as named, beside the controller, cached or shipped.

    `None` for a task that needs none.
    """
    if not controller.bundle:
        return None
    if named is not None:
        bundle = find_bundle(named)
    elif beside is not None and is_there(beside):
        bundle = Bundle.open(beside, controller.bundle)
    else:
        found = BundleStore(default_cache()).find(controller.bundle)
        if found is None:
            raise BundleError(
                f"the controller's world model {controller.bundle[:12]}... is not here: name it with --bundle FILE"
            )
        bundle = found
    return bundle.fitting(controller)


def evaluate(
    controller: Controller, bundle: Bundle | None, seeds: tuple[int, ...], jobs: int
) -> Iterator[tuple[int, float]]:
    """Drive one whole episode a seed in `jobs` processes, in this one if it is 1; yields (seed, score) as each ends."""
    pin_thread_pools()
    spec = spec_for(controller, bundle)
    if jobs == 1:  # here: a script of one's own need not guard its main part
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        scorer = Scorer(spec, bundle, judge=True)
        yield from ((seed, scorer.score("evaluate", controller.parameters, seed).fitness) for seed in seeds)
        scorer.close()
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


def _start_process() -> None:
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C reaches the whole group: end without a traceback


def _drive(spec: TaskSpec, bundle: Path | None, parameters: NDArray[np.float32], seed: int) -> tuple[int, float]:
    return seed, _scorer(spec, bundle).score("evaluate", parameters, seed).fitness


@cache
def _scorer(spec: TaskSpec, bundle: Path | None) -> Scorer:
    """One a process, made by its first drive, so that whatever is wrong is that drive's error."""
    return Scorer(spec, Bundle.open(bundle, spec.bundle) if bundle else None, judge=True)
