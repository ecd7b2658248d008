"""Judging a controller on unseen tracks, in gymnasium's own unmodified environment."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from common.bundle import Bundle, BundleStore, default_cache, find_bundle
from common.controller import Controller
from common.errors import BundleError, ControllerError
from common.messages import TaskSpec
from common.threads import pin_thread_pools
from worker.scoring import Scorer

_scorer: list[Scorer] = []  # one a process, made by the pool's initializer


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


def bundle_for(controller: Controller, named: str | None, beside: Path | None = None) -> Bundle:
    """The world model that a controller was evolved with: as named, beside the controller, cached or shipped."""
    if named is not None:
        bundle = find_bundle(named)
    elif beside is not None and beside.exists():
        bundle = Bundle.open(beside)
    else:
        found = BundleStore(default_cache()).find(controller.bundle)
        if found is None:
            raise BundleError(
                f"the controller's world model {controller.bundle[:12]}... is not here: name it with --bundle FILE"
            )
        bundle = found
    if bundle.controller_shape != controller.shape:
        raise ControllerError(
            f"a controller of {controller.shape.size} parameters does not fit {bundle.path.name}, which needs "
            f"{bundle.controller_shape.size}"
        )
    return bundle


def evaluate(controller: Controller, bundle: Bundle, seeds: tuple[int, ...], jobs: int) -> Iterator[tuple[int, float]]:
    """Drive one whole episode a seed in `jobs` processes; yields (seed, score) as each ends."""
    pin_thread_pools()
    spec = TaskSpec(controller.task, bundle.sha256, horizon=1000, patience=0)
    with get_context("spawn").Pool(
        min(jobs, len(seeds)), initializer=_start_process, initargs=(spec, bundle.path)
    ) as pool:
        yield from pool.imap_unordered(_drive, [(controller, seed) for seed in seeds])


def _start_process(spec: TaskSpec, bundle: Path) -> None:
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    _scorer[:] = [Scorer(spec, Bundle.open(bundle), judge=True)]


def _drive(task: tuple[Controller, int]) -> tuple[int, float]:
    controller, seed = task
    return seed, _scorer[0].score("evaluate", controller.parameters, seed).fitness
