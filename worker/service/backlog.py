"""What the coordinator has given this worker and no slot has taken yet, in one numbering of its batches. Pure.

Batches may come twice, late or out of order; each counts once, and a vector may be spread over several. Whoever reaches
the port can send some too, so what waits is bounded: what has no room is let go, and as the next beats do not show it,
the coordinator gives it again.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass, field
from math import prod

from dreamfleet.common.protocol.messages import MAX_LEASES, Job, JobBatch, TaskSpec, VectorPart

MAX_UNUSED_VECTORS = 64  # beside those that queued jobs need
MAX_BATCHES_AHEAD = 1024  # batches after one that is missing
MAX_VECTOR_BYTES = 256 << 20  # of all vectors; of 1024 candidates: 65,000 parameters each


@dataclass
class PartialVector:
    """What has come of a vector of `size` bytes, by offset."""

    size: int
    data: dict[int, bytes] = field(default_factory=dict)

    def content(self) -> bytes:
        """All of it, in order."""
        return b"".join(data for _, data in sorted(self.data.items()))


class Backlog:
    """Queued jobs in the order in which they came, and the vectors that they score."""

    def __init__(self, spec: TaskSpec) -> None:
        self._spec = spec
        self.start_numbering(0)
        self._jobs: OrderedDict[bytes, Job] = OrderedDict()
        self._vectors: OrderedDict[bytes, bytes | PartialVector] = OrderedDict()  # by identity
        self._bytes = 0  # of all vectors

    def start_numbering(self, numbering: int) -> None:
        """The coordinator counts batches from 1 again, under another number."""
        self.numbering = numbering
        self.seen = 0
        self._received_ahead: set[int] = set()

    def clear(self) -> None:
        """Forget what is queued: it is given again."""
        self._jobs.clear()

    @property
    def queued(self) -> list[bytes]:
        """Digests of the queued jobs."""
        return list(self._jobs)

    def add_batch(self, batch: JobBatch, in_slots: Collection[bytes] = ()) -> list[tuple[Job, str]]:
        """Queue a batch's jobs once; those whose digest is not theirs come back with what is wrong.

        Jobs that a slot has already (`in_slots`, by digest) are not queued: a coordinator that was killed while it
        opened a generation gives its jobs again in its next life.
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
                refused.append((job, "the job's digest is not of its content"))
            elif job.digest not in in_slots and job.vector in self._vectors and len(self._jobs) < MAX_LEASES:
                self._jobs[job.digest] = job
        self._trim()
        return refused

    def take(self, count: int) -> list[tuple[Job, bytes]]:
        """The first jobs whose vectors are whole, with them: at most `count` to be scored, or one that is done alone.

        They are of one specification.
        """
        taken: list[tuple[Job, bytes]] = []
        for digest, job in list(self._jobs.items()):
            if len(taken) == count or (taken and (job.runs_alone or job.overrides != taken[0][0].overrides)):
                break
            vector = self._assemble(job.vector)
            if job.vector not in self._vectors:  # what has come of it was of something else
                del self._jobs[digest]
            elif vector is not None:
                taken.append((job, vector))
                del self._jobs[digest]
                if job.runs_alone:
                    break
        return taken

    def _assemble(self, identity: bytes) -> bytes | None:
        vector = self._vectors.get(identity)
        if not isinstance(vector, PartialVector):
            return vector
        content = vector.content()
        if hashlib.sha256(content).digest() == identity:
            self._vectors[identity] = content
            return content
        if len(content) >= vector.size:
            self._drop(identity)
        return None

    def _add_part(self, part: VectorPart) -> None:
        if self._bytes + len(part.data) > MAX_VECTOR_BYTES:
            return
        parts = self._vectors.setdefault(part.id, PartialVector(int(part.dtype[-1]) * prod(part.shape)))
        if isinstance(parts, PartialVector) and part.offset not in parts.data:
            parts.data[part.offset] = part.data
            self._bytes += len(part.data)
        self._vectors.move_to_end(part.id)

    def _drop(self, identity: bytes) -> None:
        vector = self._vectors.pop(identity)
        self._bytes -= len(vector.content() if isinstance(vector, PartialVector) else vector)

    def _trim(self) -> None:
        needed = {job.vector for job in self._jobs.values()}
        surplus = [identity for identity in self._vectors if identity not in needed]
        for identity in surplus[: max(0, len(surplus) - MAX_UNUSED_VECTORS)]:
            self._drop(identity)
