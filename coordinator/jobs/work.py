"""Jobs, made from a parameter vector and seeds."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.host.stall_watch import FUNCTION_STALL_SECONDS, STALL_SECONDS
from dreamfleet.common.protocol.messages import Job, Kind, TaskSpec
from dreamfleet.common.protocol.tasks import is_function_task


@dataclass(frozen=True)
class JobTemplate:
    """What the jobs of one vector `(size,)` share; the vector is float32 little-endian bytes."""

    kind: Kind
    task: str
    generation: int
    candidate: int
    vector: bytes
    identity: bytes  # the vector's SHA-256
    stall: float
    overrides: Mapping[str, Any]


@dataclass(slots=True)
class Work:
    """A job and the vector that it scores. The job is made when it is first asked for: a generation has many."""

    template: JobTemplate
    episode: int
    seed: int
    digest: bytes
    job: Job = field(init=False, repr=False, compare=False)

    def __getattr__(self, name: str) -> Job:
        """Make the job: this is called only while it is missing."""
        if name != "job":
            raise AttributeError(name)
        shared = self.template
        self.job = Job(
            kind=shared.kind, task=shared.task, generation=shared.generation, candidate=shared.candidate,
            episode=self.episode, seeds=(self.seed,), vector=shared.identity, digest=self.digest, stall=shared.stall,
            **shared.overrides,
        )  # fmt: skip
        return self.job

    @property
    def vector(self) -> bytes:
        """The vector `(size,)` as float32 little-endian bytes."""
        return self.template.vector

    @property
    def kind(self) -> Kind:
        """The job's kind."""
        return self.template.kind


def vector_bytes(vector: NDArray[np.float64]) -> bytes:
    """A parameter vector as float32 little-endian bytes: so it is sent, scored, hashed and journalled."""
    return vector.astype("<f4").tobytes()


def make_work(
    spec: TaskSpec, kind: Kind, generation: int, candidate: int, vector: bytes, seeds: Sequence[int],
    run_spec: TaskSpec | None = None, first: int = 0,
) -> list[Work]:  # fmt: skip
    """Make a job for each seed. A job is one episode; episodes are numbered from `first` on.

    `run_spec` is the run's specification if `spec` differs from it. A job names its horizon, patience and whether it is
    driven only if they differ from the run's. R1: the digest covers kind, parameters, seeds and specification, so a
    correct result is the same from any worker and still fits after a restart.
    """
    identity = hashlib.sha256(vector).digest()
    run_spec = run_spec or spec
    stall = FUNCTION_STALL_SECONDS if is_function_task(spec.task) else STALL_SECONDS
    names = "horizon", "patience", "driven"
    overrides: dict[str, Any] = {
        name: given for name in names if (given := getattr(spec, name)) != getattr(run_spec, name)
    }
    template = JobTemplate(kind, spec.task, generation, candidate, vector, identity, stall, overrides)
    texts = _digest_texts(spec, kind, tuple(seeds))
    return [
        Work(template, episode, seed, hashlib.sha256(identity + text).digest())
        for episode, (seed, text) in enumerate(zip(seeds, texts, strict=True), first)
    ]


@lru_cache(8)
def _digest_texts(spec: TaskSpec, kind: Kind, seeds: tuple[int, ...]) -> tuple[bytes, ...]:
    """What the jobs' identities hash behind the vector's hash: the same for each candidate of a generation."""
    return tuple(spec.digest_text(kind, (seed,)) for seed in seeds)
