"""Messages from a worker to the coordinator of its run. Pages: status.md."""

import os
from collections.abc import Callable, Sequence
from typing import Any

import zenoh

from dreamfleet.common.host.fingerprint import fingerprint
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import encode, encoding
from dreamfleet.common.protocol.messages import (
    MAX_LEASES,
    TAG_BYTES,
    Heartbeat,
    Message,
    Result,
    ResultBatch,
    UploadPart,
)
from dreamfleet.worker.service.admission import Admission
from dreamfleet.worker.service.backlog import Backlog
from dreamfleet.worker.service.outbox import FilePart, Outbox
from dreamfleet.worker.service.slot_pool import SlotPool

MAX_STEPS_PER_SECOND = 1e9  # the largest rate that a heartbeat can report
SMOOTHING = 0.3  # weight of the newest interval in the rate


class StepRate:
    """Environment steps a second, smoothed over the intervals between heartbeats."""

    def __init__(self, now: float) -> None:
        self._value = 0.0
        self._last = (now, 0)

    def update(self, now: float, steps: int) -> float:
        """The rate at time `now`, when `steps` steps were made in all."""
        (then, before), self._last = self._last, (now, steps)
        if now > then:
            self._value += SMOOTHING * (max(steps - before, 0) / (now - then) - self._value)
        return self._value


class CoordinatorSender:
    """Sends to the one incarnation of a coordinator that `admission` names."""

    def __init__(self, session: zenoh.Session, identity: str, admission: Admission) -> None:
        self._session = session
        self._identity = identity
        self._admission = admission
        self._life: dict[str, Any] = {"run_uid": admission.run_uid, "incarnation": admission.incarnation}

    def send_results(self, slots: SlotPool, results: tuple[Result, ...]) -> None:
        """Send results in one message."""
        named = fingerprint(self._admission.packages, slots.torch_device)
        batch = ResultBatch(**self._life, fingerprint=named, results=results, host_class=slots.host_class)
        self._publish(keys.result, batch)

    def send_part(self, part: FilePart) -> None:
        """Send one part of a job's rollout file."""
        self._publish(keys.upload, UploadPart(**self._life, **vars(part)))

    def send_heartbeat(
        self, slots: SlotPool, backlog: Backlog, outbox: Outbox, capacity: int, rate: float, reason: str
    ) -> None:
        """Send a heartbeat: batches received so far, queued and running jobs, results without a verdict.

        R10: `seen` confirms batches, so that the coordinator does not send them again.
        R12: `numbering` names the numbering that `seen` belongs to, so it confirms no batch of another one.
        R20: every job that this worker has is listed, because a job that is not listed is given to another worker.
        """
        self._beat(
            numbering=backlog.numbering,
            seen=backlog.seen,
            capacity=capacity,
            slots=len(slots),
            queued=_tags([*backlog.queued, *(job.digest for job in slots.waiting)]),
            running=tuple(slots.running[:MAX_LEASES]),
            unacked=_tags(outbox.digests),
            steps_per_second=min(rate, MAX_STEPS_PER_SECOND),
            drawn_by=slots.drawn_by,
            host_class=slots.host_class,
            reason=reason,
            taken=min(slots.taken, capacity),
            side_by_side=slots.side_by_side,
        )

    def send_farewell(self, slots: int, reason: str) -> None:
        """Send the first and last heartbeat of a worker that fails before it can score (R24)."""
        self._beat(
            numbering=self._admission.numbering, seen=0, capacity=0, slots=slots, queued=(), running=(), unacked=(),
            steps_per_second=0.0, drawn_by="-", reason=reason,
        )  # fmt: skip

    def _beat(self, **fields: Any) -> None:
        beat = Heartbeat(**self._life, nonce=self._admission.nonce, load=os.getloadavg()[0], **fields)
        self._publish(keys.heartbeat, beat)

    def _publish(self, key: Callable[[str, str], str], message: Message) -> None:
        address = key(self._admission.run, self._identity)
        self._session.put(address, encode(message), encoding=encoding(type(message)))


def _tags(digests: Sequence[bytes]) -> tuple[bytes, ...]:
    return tuple(digest[:TAG_BYTES] for digest in digests[:MAX_LEASES])
