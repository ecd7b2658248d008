"""One snapshot a second, shared by all viewers; none while there are no viewers."""

import asyncio
import logging
from collections.abc import AsyncGenerator

from dreamfleet.common.host.error_counter import ErrorCounter
from dreamfleet.coordinator.addons.dashboard.live_runs import DashboardSnapshot, Watcher

REFRESH = 1.0  # seconds; main.js reckons with it
LINGER = 5.0  # seconds of polling after the last viewer left: the page may just be reloading
MOST_VIEWERS = 500
log = logging.getLogger(__name__)


class Feed:
    """Polls the watcher in a thread while there are viewers.

    Each viewer gets the latest snapshot when it is ready for one: a slow viewer skips some and delays nobody.
    """

    def __init__(self, watcher: Watcher, refresh: float = REFRESH, linger: float = LINGER) -> None:
        self._watcher, self._refresh, self._linger = watcher, refresh, linger
        self._error_counter = ErrorCounter(log)
        self._viewers = 0
        self._latest: DashboardSnapshot | None = None
        self._changed = asyncio.Event()  # set and replaced with each new snapshot
        self._polling: asyncio.Task[None] | None = None
        self._closed = False

    @property
    def is_full(self) -> bool:
        """Whether there is no room for another viewer."""
        return self._viewers >= MOST_VIEWERS

    async def snapshots(self) -> AsyncGenerator[DashboardSnapshot, None]:
        """The latest snapshot, then each newer one, until the feed is closed."""
        self._viewers += 1
        if self._polling is None:
            self._polling = asyncio.create_task(self._poll())
        seen = None
        try:
            while not self._closed:
                changed = self._changed
                if self._latest is not None and self._latest is not seen:
                    seen = self._latest
                    yield seen
                else:
                    await changed.wait()
        finally:
            self._viewers -= 1

    def close(self) -> None:
        """End the streams of all viewers."""
        self._closed = True
        self._notify()

    async def _poll(self) -> None:
        clock = asyncio.get_running_loop().time
        left = clock() + self._linger  # when to stop without viewers
        try:
            while not self._closed and clock() < left:
                began = clock()
                try:
                    self._latest = await asyncio.to_thread(self._watcher.poll)
                    self._notify()
                except Exception as error:  # a failed poll must not end the feed
                    self._error_counter.record("look", error, "at live runs")
                if self._viewers:
                    left = clock() + self._linger
                await asyncio.sleep(max(began + self._refresh - clock(), 0.0))
        finally:
            self._latest, self._polling = None, None
        await asyncio.to_thread(self._watcher.suspend)

    def _notify(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()
