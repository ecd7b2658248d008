"""Sampling frames of a running episode in a scoring child while somebody watches.

An episode runs many times faster than real time, so a viewer gets samples: ten frames a second, and fewer where a frame
is expensive. Sampling never takes more than a hundredth of the child's time. Pages: watch.md, dashboard.md.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from time import perf_counter, thread_time

import numpy as np

from dreamfleet.common.protocol.frame_pictures import pack_picture
from dreamfleet.worker.tasks.watching import StepSnapshot

FRAME_INTERVAL = 0.1  # seconds between two frames, at least
MAX_TIME_SHARE = 0.01  # of the child's processor time, at most
MAX_ACTIONS = 64  # numbers of an action that a frame holds


@dataclass(frozen=True)
class SampledFrame:
    """Message of a child about one step of its running group; `latent` and `state` are float32 bytes, or empty."""

    group: int
    episode: int  # its index in the group
    step: int
    score: float
    action: tuple[float, ...]
    height: int
    width: int
    picture: bytes  # compressed
    latent: bytes
    state: bytes


class FrameSampler:
    """A `StepObserver` that sends samples of steps while `is_watched`."""

    def __init__(
        self,
        send: Callable[[SampledFrame], object],
        is_watched: Callable[[], bool],
        clock: Callable[[], float] = perf_counter,
        cpu_time: Callable[[], float] = thread_time,
    ) -> None:
        """`cpu_time` gives the processor seconds of this thread, because a busy host slows down the wall clock."""
        self._send, self._is_watched, self._clock, self._cpu_time = send, is_watched, clock, cpu_time
        self._group, self._next_at = 0, 0.0

    def for_group(self, group: int) -> FrameSampler:
        """Switch to another group, and return this sampler."""
        self._group = group
        return self

    def is_due(self) -> bool:
        """Whether the next frame is due and somebody watches."""
        return self._clock() >= self._next_at and self._is_watched()

    def observe(self, episode: int, look: Callable[[], StepSnapshot]) -> None:
        """Send a frame of a step; an error here must not fail the episode, so it is ignored."""
        began, before = self._clock(), self._cpu_time()
        with suppress(Exception):
            self._send(_make_frame(self._group, episode, look()))
        self._next_at = began + max(FRAME_INTERVAL, (self._cpu_time() - before) / MAX_TIME_SHARE)


def _make_frame(group: int, episode: int, step: StepSnapshot) -> SampledFrame:
    no_picture = 1, 1, b""
    picture = no_picture if step.picture is None else pack_picture(step.picture)
    model = (b"" if each is None else each.astype("<f4").tobytes() for each in (step.latent, step.state))
    action = tuple(float(each) for each in np.ravel(step.action)[:MAX_ACTIONS])
    return SampledFrame(group, episode, step.step, float(step.score), action, *picture, *model)
