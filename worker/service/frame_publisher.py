"""Live frames of one joined run: published while somebody subscribes, and never at the cost of anything else.

A frame is the least urgent of all messages and is dropped where a link is busy: a slow viewer misses frames, and no
job, result or beat waits for him. What is dear, decoding and dreaming on, is the viewer's own work.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import zenoh

from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode, encoding
from dreamfleet.common.protocol.messages import MAX_MESSAGE, MAX_PART, TAG_BYTES, ViewFrame
from dreamfleet.common.serialization.validation import MalformedError
from dreamfleet.worker.service.admission import Admission
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import JobWithVector

FRAME_OVERHEAD = 1024  # bytes of a frame beside its picture and what a world model has in mind


class FramePublisher:
    """The publisher of a worker's frames; `on_viewers_changed` is called in Zenoh's thread as viewers come or go."""

    def __init__(
        self, session: zenoh.Session, run: str, identity: str, on_viewers_changed: Callable[[Any], None]
    ) -> None:
        self._publisher: Any = session.declare_publisher(
            keys.view(run, identity), encoding=encoding(ViewFrame),
            congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.BACKGROUND,
        )  # fmt: skip
        self._listener = self._publisher.declare_matching_listener(on_viewers_changed)

    def show(self, admission: Admission, slot: int, work: JobWithVector, frame: SampledFrame) -> None:
        """Publish what a slot showed of a job; a frame that is no message, such as of an endless score, is not sent."""
        with suppress(MalformedError):
            self._publisher.put(encode(_make_view_frame(admission, slot, work, frame)))

    def undeclare(self) -> None:
        """Show nothing more."""
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
