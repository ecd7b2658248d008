"""Rollouts on their way in: parts in any order, doubled or missing, until the whole has its hash. Pure.

Memory is bounded whatever arrives: so many uploads, so many bytes, and none that stands still for long.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, field

from dreamfleet.common.protocol.messages import MAX_PART, MAX_UPLOAD, UploadPart


@dataclass(frozen=True)
class UploadLimits:
    """How much may be open at once, in uploads and bytes, and for how many seconds one may stand still."""

    count: int = 64
    size: int = 4 * MAX_UPLOAD
    idle: float = 60.0  # several of the longest pauses that a worker makes between repetitions


@dataclass
class PartialUpload:
    """What has come of one job's file from one worker."""

    sha256: bytes
    total: int
    grew_at: float  # when it last grew
    parts: dict[int, bytes] = field(default_factory=dict)  # offset -> bytes
    whole: bytes | None = None


class UploadAssembler:
    """The open uploads, by worker and job; what is not taken in is counted by reason in `dropped`."""

    def __init__(self, config: UploadLimits | None = None) -> None:
        self.dropped: Counter[str] = Counter()
        self._config = config or UploadLimits()
        self._open: dict[tuple[str, bytes], PartialUpload] = {}

    def __len__(self) -> int:
        return len(self._open)

    @property
    def size(self) -> int:
        """Bytes that the open uploads hold at most."""
        return sum(upload.total for upload in self._open.values())

    def add(self, worker: str, part: UploadPart, now: float) -> None:
        """Take in one part; the last one that was missing makes the whole, or ends it if its hash is another."""
        if not 0 < part.total <= MAX_UPLOAD:
            self.dropped["upload of a forbidden size"] += 1
            return
        if part.offset % MAX_PART or len(part.data) != min(MAX_PART, part.total - part.offset):
            self.dropped["upload part out of place"] += 1
            return
        upload = self._find(worker, part, now)
        if upload is None or upload.whole is not None or part.offset in upload.parts:
            return
        upload.parts[part.offset] = part.data
        upload.grew_at = now
        if len(upload.parts) == -(-upload.total // MAX_PART):
            self._finish(worker, part.digest, upload)

    def get_complete(self, worker: str, digest: bytes, sha256: bytes) -> bytes | None:
        """The whole file of this hash, if this worker has sent it; it stays until `forget`."""
        upload = self._open.get((worker, digest))
        return upload.whole if upload is not None and upload.sha256 == sha256 else None

    def forget(self, digest: bytes) -> None:
        """The job is not wanted any more, from whomever."""
        for key in [key for key in self._open if key[1] == digest]:
            del self._open[key]

    def tick(self, now: float) -> None:
        """Let go of what stands still; its worker sends it again from the beginning."""
        for key in [key for key, upload in self._open.items() if now - upload.grew_at > self._config.idle]:
            del self._open[key]
            self.dropped["abandoned upload"] += 1

    def _find(self, worker: str, part: UploadPart, now: float) -> PartialUpload | None:
        key = worker, part.digest
        upload = self._open.get(key)
        if upload is not None and (upload.sha256, upload.total) == (part.sha256, part.total):
            return upload
        if upload is not None:  # driven again, to other bytes
            del self._open[key]
            self.dropped["replaced upload"] += 1
        if len(self._open) >= self._config.count or self.size + part.total > self._config.size:
            self.dropped["too many uploads"] += 1
            return None
        self._open[key] = PartialUpload(part.sha256, part.total, now)
        return self._open[key]

    def _finish(self, worker: str, digest: bytes, upload: PartialUpload) -> None:
        whole = b"".join(data for _, data in sorted(upload.parts.items()))
        if hashlib.sha256(whole).digest() == upload.sha256:
            upload.whole = whole
            upload.parts.clear()
        else:
            del self._open[worker, digest]
            self.dropped["damaged upload"] += 1
