"""A scoring child process as its parent handles it. It is spawned, because a forked Zenoh session hangs."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from dreamfleet.common.host.parent_death import signals_blocked
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.protocol.messages import TaskSpec
from dreamfleet.worker.service.child import ChildReady, serve_jobs
from dreamfleet.worker.service.failure_log import ScoringFailure
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import GroupDone, JobWithVector

EXIT_GRACE = 2.0  # seconds that a child may take to exit after it closed its pipe

ChildMessage = ChildReady | SampledFrame | GroupDone | ScoringFailure | None
"""What a child sends; the reader adds `None` when the pipe is closed."""


class ChildProcess:
    """A running child; a thread calls `on_message` with each of its messages, and with `None` at the end."""

    def __init__(
        self,
        spec: TaskSpec,
        bundle: Path | None,
        allowed_tasks: tuple[str, ...],
        on_message: Callable[[ChildMessage], None],
    ) -> None:
        pin_thread_pools()
        context = get_context("spawn")
        self._steps: Any = context.Value("Q", 0, lock=False)
        self._abandoned: Any = context.Array(
            "Q", 2, lock=False
        )  # numbers of the groups to abandon: an even and an odd one
        self._is_watched: Any = context.Value("B", 0, lock=False)
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=serve_jobs,
            args=(theirs, self._steps, self._abandoned, self._is_watched, spec, bundle, allowed_tasks, os.getpid()),
            daemon=True,
        )
        with signals_blocked():
            self._process.start()
        theirs.close()
        self._reader = threading.Thread(target=self._read, args=(on_message,), daemon=True)
        try:
            self._reader.start()
        except RuntimeError:  # the thread cannot start, so nothing would read the child's messages
            self._process.kill()
            self._process.join()
            raise

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid or 0

    @property
    def steps(self) -> int:
        """Environment steps of the running group so far, over all its jobs."""
        return int(self._steps.value)

    @property
    def memory(self) -> int:
        """Resident bytes; 0 if unknown."""
        try:
            return int(Path(f"/proc/{self.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except (OSError, ValueError, IndexError):
            return 0

    def send(self, group: int, work: Sequence[JobWithVector]) -> None:
        """Send a group of jobs. If the child is gone, the reader notices."""
        with suppress(OSError):
            self._pipe.send((group, work))

    def abandon_group(self, group: int) -> None:
        """End a group at its next step. Both of two consecutive groups can be abandoned at the same time."""
        self._abandoned[group % 2] = group

    def show(self, wanted: bool) -> None:
        """Start sending frames with the next group, or stop sending them now."""
        self._is_watched.value = wanted

    def kill(self) -> None:
        """Kill the child; the reader then reports `None`."""
        self._process.kill()

    def wait_for_exit(self) -> bool:
        """Wait up to `EXIT_GRACE` seconds for the child to exit; return whether it has."""
        until = monotonic() + EXIT_GRACE
        while self._process.is_alive() and monotonic() < until:  # a timed `join` can block on a silent child
            sleep(0.005)
        return not self._process.is_alive()

    def close(self) -> str:
        """Kill the child if it is alive, and close its pipe; return the signal that ended it, or an empty text."""
        self._process.kill()
        self._process.join()
        self._reader.join()  # before the pipe is closed, because another pipe may get its descriptor
        self._pipe.close()
        code = self._process.exitcode or 0
        return f"signal {-code}" if code < 0 else ""

    def _read(self, on_message: Callable[[ChildMessage], None]) -> None:
        with suppress(EOFError, OSError):
            while True:
                on_message(self._pipe.recv())
        on_message(None)
