"""The parent's hold on a child process: how it is spawned, spoken to, heard and ended.

Spawned, never forked: a forked Zenoh session hangs.
"""

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
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import GroupDone, JobWithVector, ScoringFailure

EXIT_GRACE = 2.0  # seconds between a child's last word and its end

ChildMessage = ChildReady | SampledFrame | GroupDone | ScoringFailure | None
"""What a child says; `None`, from the reader itself, is that it says nothing any more."""


class ChildProcess:
    """A running child; `hear` is called in a thread of its own with each word, and with `None` at the end."""

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
        self._abandoned: Any = context.Array("Q", 2, lock=False)  # turns to give up: an even one, an odd one
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
        except RuntimeError:  # no thread can be had: nobody would hear it
            self._process.kill()
            self._process.join()
            raise

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid or 0

    @property
    def steps(self) -> int:
        """Environment steps of the turn in its hands so far."""
        return int(self._steps.value)

    @property
    def memory(self) -> int:
        """Bytes of it that lie in memory; 0 where that is not known."""
        try:
            return int(Path(f"/proc/{self.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except (OSError, ValueError, IndexError):
            return 0

    def send(self, group: int, work: Sequence[JobWithVector]) -> None:
        """Give it a turn; one that is gone is noticed by its reader."""
        with suppress(OSError):
            self._pipe.send((group, work))

    def abandon_group(self, group: int) -> None:
        """Have it end a turn at its next step; of two turns that it has, both can be given up."""
        self._abandoned[group % 2] = group

    def show(self, wanted: bool) -> None:
        """Have it show steps of its turns from the next one on, or no more from now on."""
        self._is_watched.value = wanted

    def kill(self) -> None:
        """End it; its reader then says so."""
        self._process.kill()

    def wait_for_exit(self) -> bool:
        """Wait a moment until it has ended by itself; whether it has."""
        until = monotonic() + EXIT_GRACE
        while self._process.is_alive() and monotonic() < until:  # `join` would wait for a child that is only silent
            sleep(0.005)
        return not self._process.is_alive()

    def close(self) -> str:
        """End it if it lives, and release its pipe; the signal that it ended with, in words, or nothing."""
        self._process.kill()
        self._process.join()
        self._reader.join()  # before its pipe is closed, whose number the next one may have
        self._pipe.close()
        code = self._process.exitcode or 0
        return f"signal {-code}" if code < 0 else ""

    def _read(self, on_message: Callable[[ChildMessage], None]) -> None:
        with suppress(EOFError, OSError):
            while True:
                on_message(self._pipe.recv())
        on_message(None)
