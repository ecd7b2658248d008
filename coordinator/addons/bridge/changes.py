"""Wakes the streams of a batch when its coordinator announces a change."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from dreamfleet.common.addons.batches.batch_client import BatchClient
from dreamfleet.common.protocol.batches import BatchEvent

MOST_RUNS = 64  # whose events are subscribed to; streams of others ask now and then


class Changes:
    """Subscribes to the events of runs whose coordinators have answered."""

    def __init__(self, batches: BatchClient) -> None:
        self.closed = False
        self._batches = batches
        self._followers: dict[asyncio.Event, tuple[str, str]] = {}  # event to set -> run and batch
        self._subscribers: dict[str, Any] = {}

    async def close(self) -> None:
        """End all streams."""
        self.closed = True
        for changed in self._followers:
            changed.set()

    def subscribe(self, run: str) -> None:
        """Hear of a run's batches from now on."""
        if run in self._subscribers or len(self._subscribers) >= MOST_RUNS:
            return
        loop = asyncio.get_running_loop()

        def receive(event: BatchEvent) -> None:
            with suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(self._wake, run, event.id)

        self._subscribers[run] = self._batches.on_change(run, receive)

    @contextmanager
    def following(self, run: str, batch: str) -> Iterator[Callable[[float], Awaitable[None]]]:
        """Yield a function that waits until the batch has changed, or so many seconds."""
        changed = asyncio.Event()
        self._followers[changed] = run, batch

        async def wait(seconds: float) -> None:
            with suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await changed.wait()
            changed.clear()

        try:
            yield wait
        finally:
            del self._followers[changed]

    def _wake(self, run: str, batch: str) -> None:
        for changed, followed in self._followers.items():
            if followed == (run, batch):
                changed.set()
