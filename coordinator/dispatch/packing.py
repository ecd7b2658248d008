"""How work, cancellations and verdicts are cut into batches that no message limit refuses."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from dreamfleet.common.protocol.messages import MAX_MESSAGE, MAX_PART, VectorPart, Verdict
from dreamfleet.coordinator.jobs.work import Work

# Bytes of msgpack, rounded up: the envelope, and each item beside its variable part.
_ENVELOPE, _JOB, _VECTOR, _CANCEL, _VERDICT = 1024, 400, 160, 40, 80


@dataclass
class BatchContent:
    """What one batch carries."""

    vectors: list[VectorPart] = field(default_factory=list)
    work: list[Work] = field(default_factory=list)
    cancels: list[bytes] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    size: int = _ENVELOPE

    def has_vector(self, vector: bytes) -> bool:
        """Whether the vector of this identity is in the batch."""
        return any(part.id == vector for part in self.vectors)


def pack(work: Sequence[Work], cancels: Sequence[bytes], verdicts: Sequence[Verdict]) -> list[BatchContent]:
    """Everything, in order, in as few batches as fit; a job comes in or after the batch of its vector's last part."""
    batches = [BatchContent()]

    def room(size: int) -> BatchContent:
        if batches[-1].size + size > MAX_MESSAGE:
            batches.append(BatchContent())
        batches[-1].size += size
        return batches[-1]

    for verdict in verdicts:
        room(_VERDICT).verdicts.append(verdict)
    for digest in cancels:
        room(_CANCEL).cancels.append(digest)
    for each in work:
        _pack_work(each, batches, room)
    return [batch for batch in batches if batch.size > _ENVELOPE]


def _pack_work(each: Work, batches: list[BatchContent], room: Callable[[int], BatchContent]) -> None:
    if batches[-1].has_vector(each.job.vector) and batches[-1].size + _JOB <= MAX_MESSAGE:
        room(_JOB).work.append(each)
        return
    *parts, last = vector_parts(each)
    for part in parts:
        room(_VECTOR + len(part.data)).vectors.append(part)
    batch = room(_VECTOR + len(last.data) + _JOB)
    batch.vectors.append(last)
    batch.work.append(each)


def vector_parts(work: Work) -> Iterator[VectorPart]:
    """A job's vector, one part unless it is longer than a message."""
    whole = VectorPart(
        id=work.job.vector, dtype="<f4", shape=(len(work.vector) // 4,), offset=0, data=work.vector[:MAX_PART]
    )
    yield whole
    for offset in range(MAX_PART, len(work.vector), MAX_PART):
        yield replace(whole, offset=offset, data=work.vector[offset : offset + MAX_PART])
