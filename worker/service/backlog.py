"""The jobs that the coordinator has given this worker and that no slot has taken yet. Pure.

Batches may arrive twice, late or out of order, and anybody on the network can send some. Pages: threats.md.
"""

import hashlib
from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass, field
from math import prod

from dreamfleet.common.protocol.failures import Failure
from dreamfleet.common.protocol.messages import MAX_LEASES, Job, JobBatch, TaskSpec, VectorPart

# R26: unknown senders can send batches too, so what they can fill is limited. The coordinator gives a dropped job
# again, because the next heartbeats do not list it.
MAX_UNUSED_VECTORS = 64  # vectors that no queued job needs
MAX_BATCHES_AHEAD = 1024  # batches after a missing one
DAMAGED = Failure.of_host("the job's digest is not of its content")  # it says nothing of the candidate
MAX_VECTOR_BYTES = 256 << 20  # of all vectors; with 1024 candidates: 65,000 parameters each


@dataclass
class PartialVector:
    """The parts of a vector of `size` bytes that have arrived, by offset."""

    size: int
    data: dict[int, bytes] = field(default_factory=dict)

    def content(self) -> bytes:
        """The parts in order, joined."""
        return b"".join(data for _, data in sorted(self.data.items()))


class Backlog:
    """Queued jobs in order of arrival, and the vectors that they score."""

    def __init__(self, spec: TaskSpec) -> None:
        self._spec = spec
        self.start_numbering(0)
        self._jobs: OrderedDict[bytes, Job] = OrderedDict()
        self._vectors: OrderedDict[bytes, bytes | PartialVector] = OrderedDict()  # by hash
        self._bytes = 0  # of all vectors

    def start_numbering(self, numbering: int) -> None:
        """Count batches from 1 again, under another numbering.

        R12: each answer to hello starts a numbering, so batches from before a cut are not taken for current ones.
        """
        self.numbering = numbering
        self.seen = 0  # R10: the highest number up to which all batches have arrived; heartbeats report it
        self._received_ahead: set[int] = set()

    def clear(self) -> None:
        """Drop the queued jobs; the coordinator gives them again."""
        self._jobs.clear()

    def __len__(self) -> int:
        return len(self._jobs)

    @property
    def is_driven(self) -> bool:
        """Whether the job that was queued first is a drive of a task that scores candidates otherwise."""
        return bool(self._jobs) and bool(next(iter(self._jobs.values())).driven)

    @property
    def queued(self) -> list[bytes]:
        """Digests of the queued jobs."""
        return list(self._jobs)

    def add_batch(self, batch: JobBatch, in_slots: Collection[bytes] = ()) -> list[tuple[Job, Failure]]:
        """Queue the jobs of a batch; return those that are refused, each with the reason.

        R10: a batch counts once, so a repeated one changes nothing and a reordered one fills its gap.
        R2: a job whose digest is not that of its content is refused, so a forged job is never scored.
        R1: a digest names one job for good. A job that a slot has (`in_slots`, by digest) is therefore not queued again
        when a restarted coordinator gives it a second time.
        """
        if not self.seen < batch.number <= self.seen + MAX_BATCHES_AHEAD or batch.number in self._received_ahead:
            return []
        self._received_ahead.add(batch.number)
        while self.seen + 1 in self._received_ahead:
            self.seen += 1
            self._received_ahead.discard(self.seen)
        for part in batch.vectors:
            self._add_part(part)
        for digest in batch.cancels:
            self._jobs.pop(digest, None)
        refused = []
        for job in batch.jobs:
            spec = job.spec(self._spec)
            if job.digest != spec.digest(job.kind, job.vector, job.seeds) or job.task != spec.task:
                refused.append((job, DAMAGED))
            elif job.digest not in in_slots and job.vector in self._vectors and len(self._jobs) < MAX_LEASES:
                self._jobs[job.digest] = job
        self._trim()
        return refused

    def take(self, count: int, drives: int | None = None) -> list[tuple[Job, bytes]]:
        """Remove and return the first job whose vector is complete, with its vector, and others of its specification.

        They are at most `count`, or `drives` if they are drives of a task that scores candidates otherwise. A job that
        runs alone is taken alone.
        R2: a job whose vector turned out to have another hash is dropped, never scored.
        """
        taken: list[tuple[Job, bytes]] = []
        for digest, job in list(self._jobs.items()):
            if taken:
                first = taken[0][0]
                if len(taken) >= (drives if first.driven and drives else count):
                    break
                if job.is_background or job.overrides != first.overrides:
                    continue
            vector = self._assemble(job.vector)
            if job.vector not in self._vectors:  # its parts were of something else
                del self._jobs[digest]
            elif vector is not None:
                taken.append((job, vector))
                del self._jobs[digest]
                if job.is_background:
                    break
        return taken

    def _assemble(self, vector_hash: bytes) -> bytes | None:
        """The complete vector with this hash; `None` while parts are missing.

        R13: a long vector travels in parts, because each message is limited.
        R2: it is complete once its bytes have the named hash. With another hash it is dropped, so that damaged
        bytes are never scored.
        """
        vector = self._vectors.get(vector_hash)
        if not isinstance(vector, PartialVector):
            return vector
        content = vector.content()
        if hashlib.sha256(content).digest() == vector_hash:
            self._vectors[vector_hash] = content
            return content
        if len(content) >= vector.size:
            self._drop(vector_hash)
        return None

    def _add_part(self, part: VectorPart) -> None:
        if self._bytes + len(part.data) > MAX_VECTOR_BYTES:
            return
        parts = self._vectors.setdefault(part.id, PartialVector(int(part.dtype[-1]) * prod(part.shape)))
        if isinstance(parts, PartialVector) and part.offset not in parts.data:
            parts.data[part.offset] = part.data
            self._bytes += len(part.data)
        self._vectors.move_to_end(part.id)

    def _drop(self, vector_hash: bytes) -> None:
        vector = self._vectors.pop(vector_hash)
        self._bytes -= len(vector.content() if isinstance(vector, PartialVector) else vector)

    def _trim(self) -> None:
        """Drop the oldest vectors that no queued job needs."""
        needed = {job.vector for job in self._jobs.values()}
        surplus = [vector_hash for vector_hash in self._vectors if vector_hash not in needed]
        for vector_hash in surplus[: max(0, len(surplus) - MAX_UNUSED_VECTORS)]:
            self._drop(vector_hash)
