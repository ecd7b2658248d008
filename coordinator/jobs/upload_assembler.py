"""Rollouts that arrive in parts, in any order, repeated or missing, until the whole has its hash. Pure.

R26: memory is bounded whatever arrives: a number of uploads, a number of bytes, and a time without progress.
"""

import hashlib
from collections import Counter
from dataclasses import dataclass, field

from dreamfleet.common.protocol.messages import MAX_PART, MAX_UPLOAD, UploadPart

MAX_OPEN, MAX_SIZE = 64, 4 * MAX_UPLOAD  # open uploads, and their bytes
MAX_IDLE = 60.0  # seconds without a new part: several times the longest pause of a worker between repetitions
TOO_MANY = "too many uploads"  # why an upload was dropped


@dataclass
class PartialUpload:
    """The parts of one job's file from one worker."""

    sha256: bytes
    total: int
    grew_at: float  # when its last new part came
    parts: dict[int, bytes] = field(default_factory=dict)  # offset -> bytes
    whole: bytes | None = None


class UploadAssembler:
    """The open uploads by worker and job; `dropped` counts refused parts and uploads by reason."""

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self._open: dict[tuple[str, bytes], PartialUpload] = {}

    def __len__(self) -> int:
        return len(self._open)

    @property
    def size(self) -> int:
        """Bytes of the open uploads once they are whole."""
        return sum(upload.total for upload in self._open.values())

    def add(self, worker: str, part: UploadPart, now: float) -> None:
        """Add one part. The last missing one completes the upload, or drops it if the whole has another hash.

        R26: an upload that exceeds a limit is not opened; its worker sends it again later.
        """
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
        """The whole file with this hash, if this worker has sent it; it is kept until `forget`."""
        upload = self._open.get((worker, digest))
        return upload.whole if upload is not None and upload.sha256 == sha256 else None

    def forget(self, digest: bytes) -> None:
        """Drop all uploads of a job that is wanted no more."""
        for key in [key for key in self._open if key[1] == digest]:
            del self._open[key]

    def tick(self, now: float) -> None:
        """Drop uploads without progress; their workers send them again from the beginning."""
        for key in [key for key, upload in self._open.items() if now - upload.grew_at > MAX_IDLE]:
            del self._open[key]
            self.dropped["abandoned upload"] += 1

    def _find(self, worker: str, part: UploadPart, now: float) -> PartialUpload | None:
        key = worker, part.digest
        upload = self._open.get(key)
        if upload is not None and (upload.sha256, upload.total) == (part.sha256, part.total):
            return upload
        if upload is not None:  # the episode was driven again, with another result
            del self._open[key]
            self.dropped["replaced upload"] += 1
        if len(self._open) >= MAX_OPEN or self.size + part.total > MAX_SIZE:
            self.dropped[TOO_MANY] += 1
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
