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

from dreamfleet.common.pictures import pack_picture

if TYPE_CHECKING:  # a task's contract imports gymnasium, which the parent of a child need not have loaded
    from dreamfleet.worker.tasks.api import Glimpse

INTERVAL = 0.1  # seconds between two frames at least
SHARE = 0.01  # of the child's time at most
MOST_ACTIONS = 64


@dataclass(frozen=True)
class Seen:
    """A child's word of one step of the turn in its hands; numbers are float32 bytes, empty where there are none."""

    turn: int
    episode: int  # its place in the turn
    step: int
    score: float
    action: tuple[float, ...]
    height: int
    width: int
    picture: bytes  # deflated
    latent: bytes
    state: bytes


class Sampler:
    """An onlooker who samples the present while `wanted`, and tells what he sees."""

    def __init__(
        self, tell: Callable[[Seen], object], wanted: Callable[[], bool], clock: Callable[[], float] = perf_counter,
        spent: Callable[[], float] = thread_time,
    ) -> None:  # fmt: skip
        """`spent` are the processor's seconds: what others take of a busy host is no cost of showing."""
        self._tell, self._wanted, self._clock, self._spent = tell, wanted, clock, spent
        self._turn, self._next = 0, 0.0

    def of(self, turn: int) -> Sampler:
        """The same, who looks on at this turn from now on."""
        self._turn = turn
        return self

    def due(self) -> bool:
        """Whether the last frame is long enough ago, and somebody still watches."""
        return self._clock() >= self._next and self._wanted()

    def see(self, episode: int, look: Callable[[], Glimpse]) -> None:
        """Show a step; what goes wrong with it is nobody's failure."""
        began, before = self._clock(), self._spent()
        with suppress(Exception):
            self._tell(_seen(self._turn, episode, look()))
        self._next = began + max(INTERVAL, (self._spent() - before) / SHARE)


def _seen(turn: int, episode: int, glimpse: Glimpse) -> Seen:
    none = 1, 1, b""
    picture = none if glimpse.picture is None else pack_picture(glimpse.picture)
    mind = (b"" if each is None else each.astype("<f4").tobytes() for each in (glimpse.latent, glimpse.state))
    action = tuple(float(each) for each in np.ravel(glimpse.action)[:MOST_ACTIONS])
    return Seen(turn, episode, glimpse.step, float(glimpse.score), action, *picture, *mind)
