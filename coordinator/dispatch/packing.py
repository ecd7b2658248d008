"""Work, cancellations and verdicts, cut into batches that fit the message limit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from msgspec.structs import replace

from dreamfleet.common.protocol.messages import MAX_MESSAGE, MAX_PART, VectorPart, Verdict
from dreamfleet.coordinator.jobs.work import Work

# Bytes of msgpack, rounded up: the envelope, and each item without its variable part.
_ENVELOPE, _JOB, _VECTOR, _CANCEL, _VERDICT = 1024, 400, 160, 40, 80


@dataclass
class BatchContent:
    """What one batch carries; `size` is an upper bound of its bytes."""

    vectors: list[VectorPart] = field(default_factory=list)
    work: list[Work] = field(default_factory=list)
    cancels: list[bytes] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    size: int = _ENVELOPE

    def has_vector(self, vector: bytes) -> bool:
        """Whether the batch carries a part of the vector with this hash."""
        return any(part.id == vector for part in reversed(self.vectors))


@dataclass(frozen=True)
class OutgoingBatch:
    """A numbered batch for one worker; number 0 is an empty one that only shows that the coordinator is there."""

    identity: str
    numbering: int
    number: int
    content: BatchContent


def pack(work: Sequence[Work], cancels: Sequence[bytes], verdicts: Sequence[Verdict]) -> list[BatchContent]:
    """Everything, in order, in as few batches as fit.

    R13: each batch fits the message limit; a long vector travels in parts, and its job comes with the last part.
    """
    batches = [BatchContent()]

    def reserve(size: int) -> BatchContent:
        if batches[-1].size + size > MAX_MESSAGE:
            batches.append(BatchContent())
        batches[-1].size += size
        return batches[-1]

    for verdict in verdicts:
        reserve(_VERDICT).verdicts.append(verdict)
    for digest in cancels:
        reserve(_CANCEL).cancels.append(digest)
    for each in work:
        _pack_work(each, batches, reserve)
    return [batch for batch in batches if batch.size > _ENVELOPE]


def _pack_work(each: Work, batches: list[BatchContent], reserve: Callable[[int], BatchContent]) -> None:
    if batches[-1].has_vector(each.job.vector) and batches[-1].size + _JOB <= MAX_MESSAGE:
        reserve(_JOB).work.append(each)
        return
    *parts, last = vector_parts(each)
    for part in parts:
        reserve(_VECTOR + len(part.data)).vectors.append(part)
    batch = reserve(_VECTOR + len(last.data) + _JOB)
    batch.vectors.append(last)
    batch.work.append(each)


def vector_parts(work: Work) -> Iterator[VectorPart]:
    """A job's vector: one part unless it is longer than a message."""
    first = VectorPart(
        id=work.job.vector, dtype="<f4", shape=(len(work.vector) // 4,), offset=0, data=work.vector[:MAX_PART]
    )
    yield first
    for offset in range(MAX_PART, len(work.vector), MAX_PART):
        yield replace(first, offset=offset, data=work.vector[offset : offset + MAX_PART])
