"""A scoring child process as its parent handles it. It is spawned, because a forked Zenoh session hangs."""

from __future__ import annotations

import logging
import os
import socket
import struct
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from dreamfleet.common.host.descendants import Descendants
from dreamfleet.common.host.parent_death import signals_blocked
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.worker.service.child import ChildReady, ScorerArguments, serve_jobs
from dreamfleet.worker.service.failure_log import ScoringFailure
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import GroupDone, JobWithVector

log = logging.getLogger(__name__)
EXIT_GRACE = 2.0  # seconds that a child may take to exit after it closed its pipe, or after it was killed
SEND_LIMIT = 5  # seconds that a child may leave its full pipe unread: it was suspended, for example

ChildMessage = ChildReady | SampledFrame | GroupDone | ScoringFailure | None
"""What a child sends; the reader adds `None` when the pipe is closed."""


class ChildProcess:
    """A running child; a thread calls `on_message` with each of its messages, and with `None` at the end."""

    def __init__(self, arguments: ScorerArguments, on_message: Callable[[ChildMessage], None]) -> None:
        pin_thread_pools()
        context = get_context("spawn")
        self._steps: Any = context.Value("Q", 0, lock=False)
        self._abandoned: Any = context.Array(
            "Q", 2, lock=False
        )  # numbers of the groups to abandon: an even and an odd one
        self._is_watched: Any = context.Value("B", 0, lock=False)
        self._pipe, theirs = context.Pipe()
        self._limit_sending()
        self._process = context.Process(
            target=serve_jobs,
            args=(theirs, self._steps, self._abandoned, self._is_watched, arguments, os.getpid()),
            daemon=False,  # a simulator may start processes with `multiprocessing`, which daemons may not
        )
        self._descendants = Descendants()
        with signals_blocked(), self._descendants.starting():
            self._process.start()
        self._descendants.add_session(self.pid)
        theirs.close()
        self._reader = threading.Thread(target=self._read, args=(on_message,), daemon=True)
        try:
            self._reader.start()
        except RuntimeError:  # the thread cannot start, so nothing would read the child's messages
            self.kill()
            self.wait_for_exit()
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

    @property
    def exit_status(self) -> int | None:
        """Its exit status, or the negative number of the signal that ended it; `None` while it runs."""
        return self._process.exitcode

    def send(self, group: int, work: Sequence[JobWithVector]) -> bool:
        """Send a group of jobs; return whether the child reads. If it is gone, the reader notices."""
        try:
            self._pipe.send((group, work))
        except BlockingIOError:
            return False
        except OSError:
            pass
        return True

    def abandon_group(self, group: int) -> None:
        """End a group at its next step. Both of two consecutive groups can be abandoned at the same time."""
        self._abandoned[group % 2] = group

    def show(self, wanted: bool) -> None:
        """Start sending frames with the next group, or stop sending them now."""
        self._is_watched.value = wanted

    def kill(self) -> None:
        """Kill the child and its descendants, which may hold its pipe open; the reader then reports `None`."""
        self._process.kill()
        self._descendants.kill()

    def wait_for_exit(self, seconds: float = EXIT_GRACE) -> bool:
        """Wait up to `seconds` for the child to exit; return whether it has."""
        until = monotonic() + seconds
        while self._process.is_alive() and monotonic() < until:  # a timed `join` can block on a silent child
            sleep(0.005)
        return not self._process.is_alive()

    def close(self, seconds: float = EXIT_GRACE) -> None:
        """Kill the child if it is alive, and close its pipe; wait up to `seconds` for each, then leave them behind."""
        self.kill()
        if not self.wait_for_exit(seconds):
            log.warning("process %d was killed and does not end: its host blocks it; left behind", self.pid)
        self._descendants.forget()
        self._reader.join(seconds)
        if not self._reader.is_alive():  # else another pipe may get its descriptor while it still reads
            self._pipe.close()

    def _limit_sending(self) -> None:
        """Let a write to a full pipe fail after `SEND_LIMIT` seconds: the worker's one thread must never block."""
        with socket.socket(fileno=os.dup(self._pipe.fileno())) as ours:
            ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", SEND_LIMIT, 0))

    def _read(self, on_message: Callable[[ChildMessage], None]) -> None:
        with suppress(Exception):  # the pipe is closed, or one of its processes wrote rubbish into it
            while True:
                message = self._pipe.recv()
                if not isinstance(message, ChildMessage):
                    break
                on_message(message)
        on_message(None)
