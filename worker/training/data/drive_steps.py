"""Moments of recorded drives: losses of the road, and which a bundle keeps for dreams to begin at.

Pure: rewards and chance in, steps out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
FIRST_START = (
    20  # steps of a drive at which no dream begins: the memory of next to nothing is what first pictures come with
)
LOSS_STEPS = 40  # steps without a positive reward that make a loss
EARLIEST, LATEST = 60, 5  # steps before a loss between which its moment lies


class DriveStep(NamedTuple):
    """A step of a drive, before it acted; drives are numbered as they were given."""

    drive: int
    step: int


@dataclass(frozen=True)
class SampledSteps:
    """Those that were drawn: shortly before a loss of the road, one a loss, and anywhere."""

    before_losses: tuple[DriveStep, ...]
    anywhere: tuple[DriveStep, ...]

    @property
    def all(self) -> tuple[DriveStep, ...]:
        """Each once, drive by drive."""
        return tuple(sorted(self.before_losses + self.anywhere))


def find_road_losses(rewards: Floats) -> list[int]:
    """Steps at which a drive of rewards `(T,)` lost the road, as they alone tell it.

    From such a step on none is positive for `LOSS_STEPS` steps at least, and the one before it is.
    """
    paid = np.flatnonzero(rewards > 0)
    unpaid = np.diff(paid, append=len(rewards)) - 1
    return [int(step) + 1 for step in paid[unpaid >= LOSS_STEPS]]


def on_road_mask(reward: Floats) -> NDArray[np.bool_]:
    """The steps of a drive `(T,)` that another reward follows before the road counts as lost."""
    steps = np.arange(len(reward))
    paid = np.where(reward > 0, steps, 2 * len(reward) + LOSS_STEPS)
    following = np.minimum.accumulate(paid[::-1])[::-1]
    return np.asarray(following - steps < LOSS_STEPS)


def sample_steps(drives: Sequence[Floats], count: int, random: np.random.Generator) -> SampledSteps:
    """So many moments of drives by their rewards `(T,)`, half of them before losses, as far as there are any.

    The rest is drawn anywhere behind the first steps; fewer where all drives together have fewer.
    """
    lost = [DriveStep(drive, step) for drive, rewards in enumerate(drives) for step in find_road_losses(rewards)]
    lost = [each for each in lost if each.step - LATEST >= FIRST_START]
    chosen = [lost[index] for index in random.permutation(len(lost))[: count // 2]]
    before = {DriveStep(drive, _shortly_before(step, random)) for drive, step in chosen}
    anywhere = [each for each in _anywhere(drives, count, random) if each not in before]
    return SampledSteps(tuple(sorted(before)), tuple(anywhere[: count - len(before)]))


def _shortly_before(step: int, random: np.random.Generator) -> int:
    return int(random.integers(max(FIRST_START, step - EARLIEST), step - LATEST, endpoint=True))


def _anywhere(drives: Sequence[Floats], count: int, random: np.random.Generator) -> list[DriveStep]:
    """So many different moments, or all that there are; each step of each drive is as likely."""
    lengths = np.array([max(len(rewards) - FIRST_START, 0) for rewards in drives])
    ends = np.cumsum(lengths)
    places = random.choice(ends[-1], size=min(count, int(ends[-1])), replace=False)
    chosen = np.searchsorted(ends, places, side="right")
    steps = FIRST_START + places - (ends - lengths)[chosen]
    return [DriveStep(int(drive), int(step)) for drive, step in zip(chosen, steps, strict=True)]
