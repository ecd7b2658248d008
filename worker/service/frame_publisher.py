"""Publishing live frames of a run while somebody watches.

Frames have the lowest priority and are dropped where a link is busy, so no job, result or heartbeat waits for a slow
viewer. The expensive work, decoding and dreaming, is done by the viewer. Pages: watch.md.
"""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import zenoh

from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode, encoding
from dreamfleet.common.protocol.messages import MAX_MESSAGE, MAX_PART, TAG_BYTES, ViewFrame
from dreamfleet.common.schema.validation import MalformedError
from dreamfleet.worker.service.admission import Admission
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import JobWithVector

FRAME_OVERHEAD = 1024  # bytes of a frame without its picture, latent and state


class FramePublisher:
    """Publishes a worker's frames; Zenoh's thread calls `on_viewers_changed` when viewers come or go."""

    def __init__(
        self, session: zenoh.Session, run: str, identity: str, on_viewers_changed: Callable[[Any], None]
    ) -> None:
        self._publisher: Any = session.declare_publisher(
            keys.view(run, identity), encoding=encoding(ViewFrame),
            congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.BACKGROUND,
        )  # fmt: skip
        self._listener = self._publisher.declare_matching_listener(on_viewers_changed)

    def show(self, admission: Admission, slot: int, work: JobWithVector, frame: SampledFrame) -> None:
        """Publish a slot's frame of a job. A frame that cannot be encoded, as with an infinite score, is dropped."""
        with suppress(MalformedError):
            self._publisher.put(encode(_make_view_frame(admission, slot, work, frame)))

    def undeclare(self) -> None:
        """Stop publishing."""
        self._listener.undeclare()  # type: ignore[no-untyped-call]
        self._publisher.undeclare()


def _make_view_frame(admission: Admission, slot: int, work: JobWithVector, frame: SampledFrame) -> ViewFrame:
    job, vector = work
    room = min(MAX_PART, MAX_MESSAGE - FRAME_OVERHEAD - len(frame.picture) - len(frame.latent) - len(frame.state))
    latent, state = (frame.latent, frame.state) if room >= 0 and len(frame.state) <= MAX_PART else (b"", b"")
    return ViewFrame(
        run_uid=admission.run_uid, incarnation=admission.incarnation, slot=slot, tag=job.digest[:TAG_BYTES],
        step=frame.step, reward=frame.score, height=frame.height, width=frame.width, picture=frame.picture,
        packed=bool(frame.picture), kind=job.kind, generation=job.generation, candidate=job.candidate,
        seed=job.seeds[0], action=frame.action, latent=latent, state=state,
        parameters=vector if latent and len(vector) <= room else b"",
    )  # fmt: skip
