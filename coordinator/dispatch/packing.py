"""What a worker is sent: jobs, cancellations and verdicts, cut into batches that fit the message limit."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from msgspec.structs import replace

from dreamfleet.common.protocol.messages import MAX_MESSAGE, MAX_PART, VectorPart, Verdict
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob

# Bytes of msgpack, rounded up: the envelope, and each item without its variable part.
_ENVELOPE, _JOB, _VECTOR, _CANCEL, _VERDICT = 1024, 400, 160, 40, 80


@dataclass
class SentBatch:
    """What one worker is sent at once; number 0 is an empty batch that only shows that the coordinator is there."""

    identity: str
    numbering: int
    number: int = 0
    vectors: list[VectorPart] = field(default_factory=list)
    work: list[ScoringJob] = field(default_factory=list)
    cancels: list[bytes] = field(default_factory=list)
    verdicts: list[Verdict] = field(default_factory=list)
    size: int = _ENVELOPE  # an upper bound of its bytes
    first_sent_at: float = 0.0
    sent_at: float = 0.0  # the last time; -inf: send it again at once
    times: int = 1  # that it was sent


def pack(
    identity: str, numbering: int, work: Sequence[ScoringJob], cancels: Sequence[bytes], verdicts: Sequence[Verdict]
) -> list[SentBatch]:
    """Everything, in order, in as few batches as fit; they have no numbers yet.

    R13: each batch fits the message limit; a long vector travels in parts, and its job comes with the last part.
    """
    batches = [SentBatch(identity, numbering)]

    def reserve(size: int) -> SentBatch:
        if batches[-1].size + size > MAX_MESSAGE:
            batches.append(SentBatch(identity, numbering))
        batches[-1].size += size
        return batches[-1]

    for verdict in verdicts:
        reserve(_VERDICT).verdicts.append(verdict)
    for digest in cancels:
        reserve(_CANCEL).cancels.append(digest)
    for each in work:
        is_there = any(part.id == each.job.vector for part in reversed(batches[-1].vectors))
        if is_there and batches[-1].size + _JOB <= MAX_MESSAGE:
            reserve(_JOB).work.append(each)
            continue
        *parts, last = vector_parts(each)
        for part in parts:
            reserve(_VECTOR + len(part.data)).vectors.append(part)
        batch = reserve(_VECTOR + len(last.data) + _JOB)
        batch.vectors.append(last)
        batch.work.append(each)
    return [batch for batch in batches if batch.size > _ENVELOPE]


def vector_parts(work: ScoringJob) -> Iterator[VectorPart]:
    """A job's vector: one part unless it is longer than a message."""
    first = VectorPart(
        id=work.job.vector, dtype="<f4", shape=(len(work.vector) // 4,), offset=0, data=work.vector[:MAX_PART]
    )
    yield first
    for offset in range(MAX_PART, len(work.vector), MAX_PART):
        yield replace(first, offset=offset, data=work.vector[offset : offset + MAX_PART])
