"""A scoring child process as its parent handles it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from typing import Any

from dreamfleet.common.host.child import FunctionChild
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.worker.service.child import ChildReady, ScorerArguments, serve_jobs
from dreamfleet.worker.service.failure_log import ScoringFailure
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import GroupDone, JobWithVector

log = logging.getLogger(__name__)
EXIT_GRACE = 2.0  # seconds that a child may take to exit after it closed its pipe, or after it was killed
SEND_LIMIT = 5  # seconds that a child may leave its full pipe unread, as the worker's one thread must never block

ChildMessage = ChildReady | SampledFrame | GroupDone | ScoringFailure | None
"""What a child sends; the reader adds `None` when the pipe is closed."""


class ChildProcess(FunctionChild):
    """A running child; a thread calls `on_message` with each of its messages, and with `None` at the end."""

    def __init__(self, arguments: ScorerArguments, on_message: Callable[[ChildMessage], None]) -> None:
        pin_thread_pools()
        context = get_context("spawn")
        self._steps: Any = context.Value("Q", 0, lock=False)
        # Numbers of the groups to abandon: an even and an odd one.
        self._abandoned: Any = context.Array("Q", 2, lock=False)
        self._is_watched: Any = context.Value("B", 0, lock=False)

        def take(message: object) -> None:
            if not isinstance(message, ChildMessage):
                raise TypeError(type(message))  # rubbish
            on_message(message)

        shared = self._steps, self._abandoned, self._is_watched
        super().__init__(serve_jobs, *shared, arguments, on_message=take, send_limit=SEND_LIMIT)

    @property
    def steps(self) -> int:
        """Environment steps of the running group so far, over all its jobs."""
        return int(self._steps.value)

    def send_group(self, group: int, work: Sequence[JobWithVector]) -> bool:
        """Send a group of jobs; return whether the child reads. If it is gone, the reader notices."""
        return self.send((group, work))

    def abandon_group(self, group: int) -> None:
        """End a group at its next step. Both of two consecutive groups can be abandoned at the same time."""
        self._abandoned[group % 2] = group

    def show(self, wanted: bool) -> None:
        """Start sending frames with the next group, or stop sending them now."""
        self._is_watched.value = wanted

    def close(self, seconds: float = EXIT_GRACE) -> None:
        """Kill the child if it is alive, and close its pipe; wait up to `seconds` for each, then leave them behind."""
        if not self.end(limit=seconds):
            log.warning("process %d was killed and does not end: its host blocks it; left behind", self.pid)
