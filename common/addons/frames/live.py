"""Watching a worker while it scores: a stream of its newest live frames (Live frames in protocol.md).

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
from dataclasses import dataclass, field
from time import monotonic
from typing import Any

import numpy as np
import zenoh
from numpy.typing import NDArray

from dreamfleet.common.client.client import MAX_WAITING_STATUSES, Client, take_final_status
from dreamfleet.common.client.status import WorkerStatus, read_status
from dreamfleet.common.errors import ConnectionFailedError, UsageError
from dreamfleet.common.protocol import keys
from dreamfleet.common.protocol.codec import CountingDecoder
from dreamfleet.common.protocol.frame_pictures import unpack_picture
from dreamfleet.common.protocol.messages import ViewFrame
from dreamfleet.common.schema.validation import MalformedError
from dreamfleet.common.transport.session import enqueue_into

RETRY_SECONDS = 1.0  # between two searches for a worker while there is none
SILENCE_SECONDS = 2.0  # without a frame, after which the run's status is queried
PRESENT = "present"  # `WorkerStatus.state`
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class LiveFrame:
    """A decoded frame: its worker, and its contents as arrays; `None` for contents that it lacks."""

    worker: str  # name/process
    frame: ViewFrame
    picture: NDArray[np.uint8] | None = field(repr=False)  # (height, width, 3)
    latent: Floats | None = field(repr=False)
    state: Floats | None = field(repr=False)
    parameters: Floats | None = field(repr=False)

    @classmethod
    def of(cls, worker: str, frame: ViewFrame) -> LiveFrame:
        """Decode a frame; `MalformedError` if its contents do not fit its description."""
        numbers = (_decode_floats(each) for each in (frame.latent, frame.state, frame.parameters))
        return cls(worker, frame, unpack_picture(frame), *numbers)


class LiveView:
    """The newest frame of one worker of a run; use it in a `with`.

    A worker publishes frames while somebody subscribes to it. So a view subscribes to a single worker, and to another
    one when that leaves.
    """

    def __init__(self, client: Client, run: str | None = None, worker: str | None = None) -> None:
        """`run` may be omitted if only one is live. `worker` is a name or `name/process`; by default the busiest.

        `UsageError` for an unknown worker lists those of the run.
        """
        self.status = client.status(run)  # the last one received
        self.dropped = CountingDecoder()
        self._client, self._wanted = client, worker
        self._newest = _LatestSample()
        self._last_statuses: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._subscriber: Any = None
        self._subscribed_worker = ""
        self._quiet_since = self._search_at = monotonic()
        if worker is not None and self._choose_worker() is None:
            known = ", ".join(each.worker for each in self._present_workers()) or "none yet"
            raise UsageError(f"run {self.run} has no worker {worker!r}: it has {known}")

    def __enter__(self) -> LiveView:
        enqueue = enqueue_into(self._last_statuses, "status", max_waiting=MAX_WAITING_STATUSES)
        self._status_subscriber: Any = self._client.session.declare_subscriber(keys.event_status(self.run), enqueue)
        return self

    def __exit__(self, *_error: object) -> None:
        self._status_subscriber.undeclare()
        self._unsubscribe()

    def __iter__(self) -> Iterator[LiveFrame]:
        """Yield frames, skipping those that come too fast, until the run is over."""
        while not self.is_over:
            if (live := self.next(SILENCE_SECONDS)) is not None:
                yield live

    @property
    def run(self) -> str:
        """The run's name."""
        return self.status.run

    @property
    def is_over(self) -> bool:
        """Whether the run ended or was left, by the last received status."""
        return self.status.is_over

    def next(self, timeout: float) -> LiveFrame | None:
        """Wait up to `timeout` seconds for the newest frame not returned yet; `None` if there is none.

        Older frames that were not fetched in time are dropped. After a silence the run's status is queried:
        `ConnectionFailedError` if the coordinator or the named worker is gone, or another run has this name now.
        """
        if self._subscriber is None and monotonic() >= self._search_at:
            self._subscribe()
        sample = self._newest.take(timeout)
        now = monotonic()
        if sample is None:
            self._receive_last_status()
            if not self.is_over and now - self._quiet_since > SILENCE_SECONDS:
                self._refresh_status()
            return None
        live = self._decode_frame(sample)
        if live is not None:
            self._quiet_since = now
        elif now - self._quiet_since > SILENCE_SECONDS:  # only frames of another run, or damaged ones
            self._refresh_status()
        return live

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
            self.dropped.dropped[error.reason] += 1
            return None

    def _receive_last_status(self) -> None:
        """Take the final status, which a coordinator publishes as it leaves; afterwards nobody answers queries."""
        last = take_final_status(self._last_statuses, self.status.run_uid, 0.0)
        self.status = self.status if last is None else read_status(last)

    def _refresh_status(self) -> None:
        """Query the status after a silence: the run may be another one, or the worker may have left."""
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
        self._search_at = monotonic() + RETRY_SECONDS
        chosen = self._choose_worker()
        if chosen is None:
            return
        self._subscribed_worker, self._quiet_since = chosen, monotonic()
        callback = zenoh.handlers.Callback(self._newest.put, indirect=False)
        self._subscriber = self._client.session.declare_subscriber(keys.view(self.run, chosen), callback)

    def _unsubscribe(self) -> None:
        if self._subscriber is not None:
            self._subscriber.undeclare()
            self._subscriber, self._subscribed_worker = None, ""

    def _choose_worker(self) -> str | None:
        """The wanted worker, or the busiest one; `None` if there is none."""
        name = self._wanted
        found = [each for each in self._present_workers() if name in (None, each.worker, each.name)]
        return max(found, key=lambda each: each.leases).worker if found else None

    def _present_workers(self) -> list[WorkerStatus]:
        known = self._client.workers(self.run)
        return [each for each in known if each.state == PRESENT and keys.is_worker_identity(each.worker)]


class _LatestSample:
    """A buffer for one sample; a new one replaces one that was not taken."""

    def __init__(self) -> None:
        self._samples: deque[zenoh.Sample] = deque(maxlen=1)
        self._available = threading.Event()

    def put(self, sample: zenoh.Sample) -> None:
        self._samples.append(sample)
        self._available.set()

    def take(self, timeout: float) -> zenoh.Sample | None:
        self._available.wait(timeout)
        self._available.clear()
        return self._samples.popleft() if self._samples else None


def _decode_floats(data: bytes) -> Floats | None:
    if not data:
        return None
    if len(data) % 4:
        raise MalformedError("wrong length")
    found = np.frombuffer(data, "<f4").astype(np.float32)
    if not np.isfinite(found).all():
        raise MalformedError("not finite")
    return found
