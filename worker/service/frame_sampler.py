"""What a scoring child shows of its episode while somebody watches: steps now and then, thinned out by the clock.

The loop is many times faster than the drive that it computes, so frames are samples of the present: ten a second, and
fewer where to show one takes long. Showing never takes more than a hundredth of the child's time, whatever is shown.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from time import perf_counter, thread_time
from typing import TYPE_CHECKING

import numpy as np

from dreamfleet.common.protocol.frame_pictures import pack_picture

if TYPE_CHECKING:  # a task's contract imports gymnasium, which the parent of a child need not have loaded
    from dreamfleet.worker.tasks.api import StepSnapshot

FRAME_INTERVAL = 0.1  # seconds between two frames at least
MAX_TIME_SHARE = 0.01  # of the child's time at most
MAX_ACTIONS = 64


@dataclass(frozen=True)
class SampledFrame:
    """A child's word of one step of the turn in its hands; numbers are float32 bytes, empty where there are none."""

    group: int
    episode: int  # its place in the turn
    step: int
    score: float
    action: tuple[float, ...]
    height: int
    width: int
    picture: bytes  # deflated
    latent: bytes
    state: bytes


class FrameSampler:
    """An observer that samples steps while `is_watched`, and sends them."""

    def __init__(
        self,
        send: Callable[[SampledFrame], object],
        is_watched: Callable[[], bool],
        clock: Callable[[], float] = perf_counter,
        cpu_time: Callable[[], float] = thread_time,
    ) -> None:
        """`cpu_time` counts this thread's processor seconds: what others take of a busy host is no cost of sampling."""
        self._send, self._is_watched, self._clock, self._cpu_time = send, is_watched, clock, cpu_time
        self._group, self._next_at = 0, 0.0

    def for_group(self, group: int) -> FrameSampler:
        """The same, who looks on at this turn from now on."""
        self._group = group
        return self

    def due(self) -> bool:
        """Whether the last frame is long enough ago, and somebody still watches."""
        return self._clock() >= self._next_at and self._is_watched()

    def see(self, episode: int, look: Callable[[], StepSnapshot]) -> None:
        """Show a step; what goes wrong with it is nobody's failure."""
        began, before = self._clock(), self._cpu_time()
        with suppress(Exception):
            self._send(_make_frame(self._group, episode, look()))
        self._next_at = began + max(FRAME_INTERVAL, (self._cpu_time() - before) / MAX_TIME_SHARE)


def _make_frame(group: int, episode: int, glimpse: StepSnapshot) -> SampledFrame:
    none = 1, 1, b""
    picture = none if glimpse.picture is None else pack_picture(glimpse.picture)
    mind = (b"" if each is None else each.astype("<f4").tobytes() for each in (glimpse.latent, glimpse.state))
    action = tuple(float(each) for each in np.ravel(glimpse.action)[:MAX_ACTIONS])
    return SampledFrame(group, episode, glimpse.step, float(glimpse.score), action, *picture, *mind)
