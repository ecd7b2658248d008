"""A scoring child process as its parent handles it. Pages: monitor.md."""

import logging
import math
from collections.abc import Callable, Sequence
from multiprocessing import get_context
from time import monotonic
from typing import Any

from dreamfleet.common.host.child import FunctionChild
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.protocol.failures import Failure
from dreamfleet.worker.scoring.failure_cause import crash
from dreamfleet.worker.service.child import ChildReady, ScorerArguments, serve_jobs
from dreamfleet.worker.service.failure_log import ScoringFailure
from dreamfleet.worker.service.frame_sampler import SampledFrame
from dreamfleet.worker.service.job_group import GroupDone, JobWithVector

log = logging.getLogger(__name__)
EXIT_GRACE = 2.0  # seconds that a child may take to exit after it closed its pipe, or after it was killed
LOOK_INTERVAL = 0.5  # seconds between two looks whether the child still runs
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

        self._sent = 0  # groups
        self._kill_reason = ""
        self.start_failure: Failure | None = None  # that it reported
        self._looked_at = 0.0
        self._given_up_at = math.inf  # when it counts as gone in any case, as it was killed or has exited
        shared = self._steps, self._abandoned, self._is_watched
        super().__init__(serve_jobs, *shared, arguments, on_message=take, send_limit=SEND_LIMIT)

    @property
    def steps(self) -> int:
        """Environment steps of the running group so far, over all its jobs."""
        return int(self._steps.value)

    def send_group(self, work: Sequence[JobWithVector]) -> int:
        """Send a group of jobs and return its number, from 1. A child that does not read is killed."""
        self._sent += 1
        if not self.send((self._sent, work)):
            self.kill_for("it read no job")
        return self._sent

    def abandon_group(self, group: int) -> None:
        """End a group at its next step. Both of two consecutive groups can be abandoned at the same time."""
        self._abandoned[group % 2] = group

    def show(self, wanted: bool) -> None:
        """Start sending frames with the next group, or stop sending them now."""
        self._is_watched.value = wanted

    def kill_for(self, why: str) -> None:
        """Kill it; the first reason is the one that counts."""
        if not self._kill_reason:
            self._kill_reason = why
            self._kill_and_give_up()

    def is_gone_unheard(self, now: float) -> bool:
        """Whether it counts as gone though its pipe is open: a process that it left behind holds that, for example."""
        if 0 <= now - self._looked_at < LOOK_INTERVAL:
            return False
        self._looked_at = now
        if self._given_up_at == math.inf and self.exit_code is not None:
            self._kill_and_give_up()  # what it left behind, so that the reader hears the end after the last message
        return monotonic() > self._given_up_at

    def _kill_and_give_up(self) -> None:
        self.kill()
        self._given_up_at = monotonic() + EXIT_GRACE

    def close_ended(self) -> Failure:
        """Close it once it is gone, and return why it ended."""
        if self._given_up_at == math.inf:
            self.wait(EXIT_GRACE)
        status = self.exit_code
        self.close(LOOK_INTERVAL)
        if self._kill_reason or status is None:
            return crash(self._kill_reason or "it closed its pipe and ran on")
        return self.start_failure or crash(status)

    def close(self, seconds: float = EXIT_GRACE) -> None:
        """Kill the child if it is alive, and close its pipe; wait up to `seconds` for each, then leave them behind."""
        if not self.end(limit=seconds):
            log.warning("process %d was killed and does not end: its host blocks it; left behind", self.pid)
