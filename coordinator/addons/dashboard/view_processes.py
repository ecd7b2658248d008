"""Live views for the page: one `dreamfleet live` process for each target, shared by all its viewers.

The dashboard's process has no simulator and no world model. A view's process starts with the first viewer and ends soon
after the last one, so that workers publish frames only while somebody watches. `page/view.js` shows them.
"""

from __future__ import annotations

import asyncio
import re
from base64 import b64encode
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from dreamfleet.common.addons.frames.mjpeg import read_parts
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.processes import VerbProcess
from dreamfleet.common.printable import truncate
from dreamfleet.common.protocol import keys
from dreamfleet.coordinator.addons.dashboard.feed import LINGER
from dreamfleet.coordinator.addons.web.documents import event

RATE = 10  # pictures a second
CHECK_INTERVAL = 0.5  # seconds between checks for viewers
STALLED = 15.0  # seconds after which a viewer that takes nothing no longer counts
TIMEOUT = 3.0  # seconds for a process to exit after its stream ended
MOST_VIEWERS = 200
LONGEST = 500  # characters of a process's last message
NICE = ("nice", "-n", "10")  # workers on this host go first
WORKER, BEST, GENERATION = "worker", "best", "generation"
_NUMBER = re.compile(r"\d{1,9}")


@dataclass(frozen=True)
class ViewTarget:
    """What a view shows: a worker by `name/process`, the best mean, a generation's mean, or the busiest worker."""

    run: str
    kind: str = ""
    name: str = ""

    @classmethod
    def of(cls, asked: Mapping[str, str]) -> ViewTarget:
        """Parse a URL's query parameters; `UsageError` for invalid names."""
        run, worker, generation = keys.check_run_name(asked.get("run", "")), asked.get(WORKER), asked.get(GENERATION)
        if worker is not None:
            if not keys.is_worker_identity(worker):
                raise UsageError("worker must be name/process, as the page shows it")
            return cls(run, WORKER, worker)
        if generation is not None:
            if not _NUMBER.fullmatch(generation):
                raise UsageError("generation must be a number")
            return cls(run, GENERATION, generation)
        return cls(run, BEST if BEST in asked else "")

    def flags(self, connection_flags: Sequence[str], runs_dir: Path) -> list[str]:
        """The flags of `dreamfleet live` for this target; `connection_flags` lead to the fleet."""
        if self.kind == GENERATION:
            return [f"--controller={self.run}", f"--generation={self.name}", f"--runs-dir={runs_dir}"]
        whom = {WORKER: [f"--worker={self.name}"], BEST: ["--best"]}.get(self.kind, [])
        return [f"--run={self.run}", *connection_flags, *whom]


class ViewProcesses:
    """All open views; used by one event loop."""

    def __init__(self, connection_flags: Sequence[str], runs_dir: Path, limit: int) -> None:
        """`connection_flags` lead to the fleet; at most `limit` processes at a time, 0: no live views."""
        self._connection_flags, self._runs_dir, self._limit = connection_flags, runs_dir, limit
        self._views: dict[ViewTarget, _ViewProcess] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._closed = False

    @property
    def is_enabled(self) -> bool:
        """Whether live views are allowed."""
        return self._limit > 0

    @property
    def is_full(self) -> bool:
        """Whether there is no room for another viewer."""
        return sum(each.viewers for each in self._views.values()) >= MOST_VIEWERS

    async def events(self, target: ViewTarget) -> AsyncIterator[bytes]:
        """Each new picture, or a notice in its place, until the view ends."""
        view = self._views.get(target)
        if view is None or view.is_closing:
            if self._closed or not self._has_room():
                yield notice_event("ended", f"{self._limit} live views are open, the most allowed here: leave one")
                return
            try:
                view = self._views[target] = _ViewProcess(target.flags(self._connection_flags, self._runs_dir))
            except OSError as error:
                yield notice_event("ended", f"no process can be started here: {error}")
                return
            self._tasks.add(view.task)
            view.task.add_done_callback(self._tasks.discard)
        async for each in view.events():
            yield each

    def _has_room(self) -> bool:
        """Whether one more view may start; closes a view without viewers to make room."""
        self._views = {target: each for target, each in self._views.items() if not each.is_closing}
        if len(self._views) < self._limit:
            return True
        idle = next((each for each in self._views.values() if not each.viewers), None)
        if idle is not None:
            idle.task.cancel()
        return idle is not None

    async def close(self) -> None:
        """End all views and their processes."""
        self._closed = True
        for each in self._tasks:
            each.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)


class _ViewProcess:
    """One process and its viewers. A slow viewer skips pictures and delays nobody."""

    def __init__(self, flags: Sequence[str]) -> None:
        self.viewers = 0
        self.is_closing = False  # its process is ending
        self._over = False  # nothing comes after the latest
        self._latest = notice_event(
            "starting", "Starting: the first picture takes some seconds, on a busy host half a minute."
        )
        self._pictures = 0
        self._sending_since: dict[object, float] = {}  # by viewer that is being sent something: since when
        self._changed = asyncio.Event()  # set and replaced with each new event
        self._ended = asyncio.Event()  # its process closed the stream
        self._loop = asyncio.get_running_loop()
        # The child is signalled when the thread that started it dies, so the loop's own thread starts it.
        self._child = VerbProcess(
            "live", *flags, "--fps", RATE, "--out", "-", inside=NICE, read=self._read, ends_with_parent=True
        )
        self.task = asyncio.create_task(self._run())

    async def events(self) -> AsyncIterator[bytes]:
        """The latest event, then each newer one."""
        self.viewers += 1
        seen, viewer = None, object()
        try:
            while True:
                changed = self._changed
                if self._latest is not seen:
                    seen = self._latest
                    self._sending_since[viewer] = self._loop.time()
                    yield seen
                    del self._sending_since[viewer]
                elif self._over:
                    return
                else:
                    await changed.wait()
        finally:
            self._sending_since.pop(viewer, None)
            self.viewers -= 1

    async def _run(self) -> None:
        """Run until the process ends or no viewers are left."""
        clock = self._loop.time
        left, heard = clock() + LINGER, ""
        try:
            while not self._ended.is_set() and clock() < left:
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._ended.wait(), CHECK_INTERVAL)
                late = clock() - STALLED
                if self.viewers > sum(since < late for since in self._sending_since.values()):
                    left = clock() + LINGER
                if not self._pictures and self._child.lines and (said := self._child.lines[-1]) != heard:
                    heard = said
                    self._publish(notice_event("waiting", said))
        finally:
            self.is_closing = True
            await asyncio.shield(asyncio.create_task(asyncio.to_thread(self._stop_process)))
            self._over = True
            self._publish(notice_event("ended", _end_reason(self._child)))

    def _stop_process(self) -> None:
        """In a thread: wait for a process whose stream ended; kill any other, which has nothing to lose."""
        if self._ended.is_set():
            self._child.wait(TIMEOUT)
        self._child.end(timeout=0)

    def _read(self, stream: IO[bytes]) -> None:
        """In a thread: read the process's pictures; repeated ones are sent once."""
        before = b""
        with suppress(RuntimeError), stream:  # the loop may be closed
            for picture, facts in read_parts(stream):
                if picture != before:
                    before = picture
                    self._loop.call_soon_threadsafe(self._publish_picture, _picture_event(picture, facts))
            self._loop.call_soon_threadsafe(self._ended.set)

    def _publish_picture(self, picture: bytes) -> None:
        self._pictures += 1
        self._publish(picture)

    def _publish(self, latest: bytes) -> None:
        self._latest = latest
        self._changed.set()
        self._changed = asyncio.Event()


def notice_event(state: str, text: str) -> bytes:
    """An event in a picture's place; `state` is `starting`, `waiting` or `ended`."""
    return event("state", {"state": state, "text": truncate(text.strip(), LONGEST)})


def _picture_event(picture: bytes, facts: Mapping[str, Any]) -> bytes:
    shown = {name: truncate(value, LONGEST) if isinstance(value, str) else value for name, value in facts.items()}
    return event("picture", {"facts": shown, "jpeg": b64encode(picture).decode()})


def _end_reason(child: VerbProcess) -> str:
    code = child.exit_code or 0
    return f"The process that draws it was ended by signal {-code}." if code < 0 else child.last_line()
