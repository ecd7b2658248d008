"""Jobs, made from a parameter vector and seeds. Pages: determinism.md."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dreamfleet.common.host.stall_watch import FUNCTION_STALL_SECONDS, STALL_SECONDS
from dreamfleet.common.protocol.messages import Job, Kind, TaskSpec
from dreamfleet.common.protocol.tasks import is_function_task


@dataclass(slots=True)
class ScoringJob:
    """A job and the vector `(size,)` that it scores, as float32 little-endian bytes.

    A generation has many, so the job is made when it is first asked for: it is `template`, the first job of the vector,
    with another episode, seed and digest.
    """

    template: Job
    vector: bytes
    episode: int
    seed: int
    digest: bytes
    job: Job = field(init=False, repr=False, compare=False)

    def __getattr__(self, name: str) -> Job:
        """Make the job: this is called only while it is missing."""
        if name != "job":
            raise AttributeError(name)
        self.job = replace(self.template, episode=self.episode, seeds=(self.seed,), digest=self.digest)
        return self.job

    @property
    def kind(self) -> Kind:
        """The job's kind."""
        return self.template.kind


def vector_bytes(vector: NDArray[np.float64]) -> bytes:
    """A parameter vector as float32 little-endian bytes: so it is sent, scored, hashed and journalled."""
    return vector.astype("<f4").tobytes()


def make_jobs(
    spec: TaskSpec, kind: Kind, generation: int, candidate: int, vector: bytes, seeds: Sequence[int],
    run_spec: TaskSpec | None = None, first: int = 0,
) -> list[ScoringJob]:  # fmt: skip
    """Make a job for each seed. A job is one episode; episodes are numbered from `first` on.

    `run_spec` is the run's specification if `spec` differs from it. A job names its horizon, patience and whether it is
    driven only if they differ from the run's. R1: the digest covers kind, parameters, seeds and specification, so a
    correct result is the same from any worker and still fits after a restart.
    """
    if not seeds:
        return []
    identity, run_spec = hashlib.sha256(vector).digest(), run_spec or spec
    digests = [hashlib.sha256(identity + text).digest() for text in _digest_texts(spec, kind, tuple(seeds))]
    stall = FUNCTION_STALL_SECONDS if is_function_task(spec.task) else STALL_SECONDS
    template = Job(kind, spec.task, generation, candidate, first, (seeds[0],), identity, digests[0], stall)
    for name in ("horizon", "patience", "driven"):
        if (given := getattr(spec, name)) != getattr(run_spec, name):
            template = replace(template, **{name: given})
    found = zip(seeds, digests, strict=True)
    return [ScoringJob(template, vector, episode, *each) for episode, each in enumerate(found, first)]


@lru_cache(8)
def _digest_texts(spec: TaskSpec, kind: Kind, seeds: tuple[int, ...]) -> tuple[bytes, ...]:
    """What the jobs' identities hash behind the vector's hash: the same for each candidate of a generation."""
    return tuple(spec.digest_text(kind, (seed,)) for seed in seeds)
