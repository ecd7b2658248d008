"""From a parameter vector and seeds to jobs."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.protocol.messages import Job, Kind, TaskSpec

STALL_SECONDS = 30.0


@dataclass(frozen=True)
class Work:
    """A job and the vector `(size,)` that it scores, as float32 little-endian bytes."""

    job: Job
    vector: bytes


def vector_bytes(vector: NDArray[np.float64]) -> bytes:
    """A parameter vector as it travels, is scored, hashed and journalled: float32, little-endian."""
    return vector.astype("<f4").tobytes()


def make_work(
    spec: TaskSpec, kind: Kind, generation: int, candidate: int, vector: bytes, seeds: Sequence[int],
    run_spec: TaskSpec | None = None, first: int = 0,
) -> list[Work]:  # fmt: skip
    """One job an episode, numbered from `first` on; `seeds` holds one seed an episode.

    `run_spec` is the run's specification where `spec` is another.

    A job names its temperature, horizon, patience and whether it is driven only where they are not the run's own.
    """
    identity = hashlib.sha256(vector).digest()
    run_spec = run_spec or spec
    return [
        Work(
            Job(
                kind=kind,
                task=spec.task,
                generation=generation,
                candidate=candidate,
                episode=episode,
                seeds=(seed,),
                vector=identity,
                digest=spec.digest(kind, identity, (seed,)),
                stall=STALL_SECONDS,
                temperature=None if spec.temperature == run_spec.temperature else spec.temperature,
                horizon=None if spec.horizon == run_spec.horizon else spec.horizon,
                patience=None if spec.patience == run_spec.patience else spec.patience,
                driven=None if spec.driven == run_spec.driven else spec.driven,
            ),
            vector,
        )
        for episode, seed in enumerate(seeds, first)
    ]
