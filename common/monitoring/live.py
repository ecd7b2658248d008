"""Looking on while a worker scores: its live frames, the newest one alone, whoever else watches.

>>> with Client(address) as client, LiveView(client, "cartpole") as view:
...     for sight in view:
...         print(sight.worker.split("/")[0], sight.frame.seed > 0)
...         break
alpha True
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from time import monotonic
from types import TracebackType
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from dreamfleet.common.errors import ConnectionFailedError, UsageError
from dreamfleet.common.monitoring.client import Client
from dreamfleet.common.monitoring.status import WorkerStatus, read_document, read_status
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder
from dreamfleet.common.protocol.frame_pictures import unpack_picture
from dreamfleet.common.protocol.messages import ViewFrame
from dreamfleet.common.serialization.validation import MalformedError
from dreamfleet.common.transport.session import enqueue_into

RETRY_SECONDS = 1.0  # seconds between looks for a worker, where there is none
SILENCE_SECONDS = 2.0  # seconds without a frame after which the run is asked whether the worker is still there
PRESENT = "present"  # a worker's state
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class LiveFrame:
    """A frame that was looked at: of whom it is, and what is in it, as arrays; `None` is what it does not hold."""

    worker: str  # name/life
    frame: ViewFrame
    picture: NDArray[np.uint8] | None = field(repr=False)  # (height, width, 3)
    latent: Floats | None = field(repr=False)
    state: Floats | None = field(repr=False)
    parameters: Floats | None = field(repr=False)

    @classmethod
    def of(cls, worker: str, frame: ViewFrame) -> LiveFrame:
        """`MalformedError` for a frame whose contents are not what it says."""
        numbers = (_decode_floats(each) for each in (frame.latent, frame.state, frame.parameters))
        return cls(worker, frame, unpack_picture(frame), *numbers)


class LiveView:
    """The newest frame of one worker of a run; use it in a `with`.

    Each worker that somebody subscribes to publishes, so a view subscribes to one, and to another where that one goes.
    """

    def __init__(self, client: Client, run: str | None = None, worker: str | None = None) -> None:
        """`run` may be left out where only one is live; `worker` is its name, or `name/life`, or whoever works.

        `UsageError` names the workers where there is none of this name.
        """
        self.status = client.status(run)  # as it was asked last
        self.dropped = CountingDecoder()
        self._client, self._wanted = client, worker
        self._newest = _LatestSample()
        self._last_statuses: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._subscriber: Any = None
        self._subscribed_worker = ""
        self._quiet_since = self._look_at = monotonic()
        if worker is not None and self._choose_worker() is None:
            known = ", ".join(each.worker for each in self._present_workers()) or "none yet"
            raise UsageError(f"run {self.run} has no worker {worker!r}: it has {known}")

    def __enter__(self) -> LiveView:
        enqueue = enqueue_into(self._last_statuses, "status", most=1)
        self._status_subscriber: Any = self._client.session.declare_subscriber(keys.event_status(self.run), enqueue)
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        self._status_subscriber.undeclare()
        self._unsubscribe()

    def __iter__(self) -> Iterator[LiveFrame]:
        """Every sight that there is time for, until the run is over."""
        while not self.is_over:
            if (sight := self.next(SILENCE_SECONDS)) is not None:
                yield sight

    @property
    def run(self) -> str:
        """The run's name."""
        return self.status.run

    @property
    def is_over(self) -> bool:
        """Whether the run ended or was left, as far as is known."""
        return self.status.is_over

    def next(self, timeout: float) -> LiveFrame | None:
        """The newest frame that was not taken yet, waited for until `timeout`; `None` if there is none, or none yet.

        Of frames that come faster than they are taken only the newest is kept. After a silence the run is asked:
        `ConnectionFailedError` where its coordinator is gone, where the named worker is, or where it is another run.
        """
        if self._subscriber is None and monotonic() >= self._look_at:
            self._subscribe()
        sample = self._newest.take(timeout)
        now = monotonic()
        if sample is None:
            self._receive_last_status()
            if not self.is_over and now - self._quiet_since > SILENCE_SECONDS:
                self._refresh_status()
            return None
        sight = self._decode_frame(sample)
        if sight is not None:
            self._quiet_since = now
        elif now - self._quiet_since > SILENCE_SECONDS:  # what comes is of another run, or nobody's
            self._refresh_status()
        return sight

    def _decode_frame(self, sample: zenoh.Sample) -> LiveFrame | None:
        frame = self.dropped.decode(ViewFrame, sample.payload.to_bytes())
        if frame is None:
            return None
        if frame.run_uid != self.status.run_uid:
            self.dropped.dropped["foreign run"] += 1
            return None
        try:
            return LiveFrame.of(keys.worker_from_key(str(sample.key_expr)), frame)
        except MalformedError as error:
            self.dropped.dropped[error.args[0]] += 1
            return None

    def _receive_last_status(self) -> None:
        """As the coordinator leaves it says how the run is; nobody answers for it afterwards."""
        with suppress(queue.Empty):
            _, sample = self._last_statuses.get_nowait()
            self.status = read_status(read_document(sample.payload.to_bytes()))

    def _refresh_status(self) -> None:
        """After a silence: is the run still the same, and is the worker still there."""
        self._quiet_since = monotonic()
        status = self._client.status(self.run)
        if status.run_uid != self.status.run_uid:
            raise ConnectionFailedError(f"run {self.run} is another run now; watch it by the same command")
        self.status = status
        if not self.is_over and self._subscribed_worker not in {each.worker for each in self._present_workers()}:
            self._unsubscribe()
            if self._wanted is not None and self._choose_worker() is None:
                raise ConnectionFailedError(
                    f"worker {self._wanted} has left run {self.run}: name another with --worker, or none for any"
                )

    def _subscribe(self) -> None:
        """Subscribe to a worker, if there is one."""
        self._look_at = monotonic() + RETRY_SECONDS
        chosen = self._choose_worker()
        if chosen is None:
            return
        self._subscribed_worker, self._quiet_since = chosen, monotonic()
        take = zenoh.handlers.Callback(self._newest.put, indirect=False)
        self._subscriber = self._client.session.declare_subscriber(keys.view(self.run, chosen), take)

    def _unsubscribe(self) -> None:
        if self._subscriber is not None:
            self._subscriber.undeclare()
            self._subscriber, self._subscribed_worker = None, ""

    def _choose_worker(self) -> str | None:
        """The wanted worker, or the busiest."""
        name = self._wanted
        found = [
            each for each in self._present_workers() if name is None or name in (each.worker, each.worker.split("/")[0])
        ]
        return max(found, key=lambda each: each.leases).worker if found else None

    def _present_workers(self) -> list[WorkerStatus]:
        known = self._client.workers(self.run)
        return [each for each in known if each.state == PRESENT and keys.is_worker_identity(each.worker)]


class _LatestSample:
    """One place: what is put replaces what was not taken."""

    def __init__(self) -> None:
        self._kept: deque[zenoh.Sample] = deque(maxlen=1)
        self._there = threading.Event()

    def put(self, sample: zenoh.Sample) -> None:
        self._kept.append(sample)
        self._there.set()

    def take(self, timeout: float) -> zenoh.Sample | None:
        self._there.wait(timeout)
        self._there.clear()
        return self._kept.popleft() if self._kept else None


def _decode_floats(data: bytes) -> Floats | None:
    if not data:
        return None
    if len(data) % 4:
        raise MalformedError("wrong length")
    found = np.frombuffer(data, "<f4").astype(np.float32)
    if not np.isfinite(found).all():
        raise MalformedError("not finite")
    return found
