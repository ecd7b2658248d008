"""What the coordinator has given this worker and no slot has taken yet, in one numbering of its batches. Pure.

Batches may come twice, late or out of order; each counts once, and a vector may be spread over several.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Collection

from dreamfleet.common.messages import Job, JobBatch, TaskSpec, VectorPart

KEPT_VECTORS = 64  # beside those that queued jobs need


class Backlog:
    """Queued jobs in the order in which they came, and the vectors that they score."""

    def __init__(self, spec: TaskSpec) -> None:
        self._spec = spec
        self.begin(0)
        self._jobs: OrderedDict[bytes, Job] = OrderedDict()
        self._vectors: OrderedDict[bytes, bytes | dict[int, bytes]] = OrderedDict()  # identity -> whole, or by offset

    def begin(self, numbering: int) -> None:
        """The coordinator counts batches from 1 again, under another number."""
        self.numbering = numbering
        self.seen = 0
        self._ahead: set[int] = set()

    def clear(self) -> None:
        """Forget what is queued: it is given again."""
        self._jobs.clear()

    @property
    def queued(self) -> list[bytes]:
        """Digests of the queued jobs."""
        return list(self._jobs)

    def take_in(self, batch: JobBatch, held: Collection[bytes] = ()) -> list[tuple[Job, str]]:
        """Queue a batch's jobs once; those whose digest is not theirs come back with what is wrong.

        Those that a slot has in hand (`held`, by digest) are not queued: a coordinator that was killed as it opened a
        generation gives its jobs again in its next life.
        """
        if batch.number <= self.seen or batch.number in self._ahead:
            return []
        self._ahead.add(batch.number)
        while self.seen + 1 in self._ahead:
            self.seen += 1
            self._ahead.discard(self.seen)
        for part in batch.vectors:
            self._add_part(part)
        for digest in batch.cancels:
            self._jobs.pop(digest, None)
        refused = []
        for job in batch.jobs:
            spec = job.spec(self._spec)
            if job.digest != spec.digest(job.kind, job.vector, job.seeds) or job.task != spec.task:
                refused.append((job, "the job's digest is not of its content"))
            elif job.digest not in held:
                self._jobs[job.digest] = job
        self._trim()
        return refused

    def take(self, count: int) -> list[tuple[Job, bytes]]:
        """The first jobs whose vectors are whole, with them: at most `count` to be scored, or one that is done alone.

        They are of one specification.
        """
        taken: list[tuple[Job, bytes]] = []
        for digest, job in list(self._jobs.items()):
            if len(taken) == count or (taken and (job.alone or job.terms != taken[0][0].terms)):
                break
            if (vector := self._whole(job.vector)) is not None:
                taken.append((job, vector))
                del self._jobs[digest]
                if job.alone:
                    break
        return taken

    def _whole(self, identity: bytes) -> bytes | None:
        vector = self._vectors.get(identity)
        if isinstance(vector, bytes):
            return vector
        joined = b"".join(data for _, data in sorted((vector or {}).items()))
        if hashlib.sha256(joined).digest() != identity:
            return None
        self._vectors[identity] = joined
        return joined

    def _add_part(self, part: VectorPart) -> None:
        parts = self._vectors.setdefault(part.id, {})
        if not isinstance(parts, bytes):
            parts[part.offset] = part.data
        self._vectors.move_to_end(part.id)

    def _trim(self) -> None:
        needed = {job.vector for job in self._jobs.values()}
        surplus = [identity for identity in self._vectors if identity not in needed]
        for identity in surplus[: max(0, len(surplus) - KEPT_VECTORS)]:
            del self._vectors[identity]
