"""Steps of recorded drives, found from their rewards: losses of the road, and beginnings of dreams for a bundle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
FIRST_START = 20  # first step of a drive at which a dream may begin; before it the recurrent state is almost empty
LOSS_STEPS = 40  # steps without a positive reward that count as a loss of the road
EARLIEST, LATEST = 60, 5  # bounds of the steps before a loss at which a dream may begin


class DriveStep(NamedTuple):
    """A step of a drive, before its action; drives are numbered in their given order."""

    drive: int
    step: int


@dataclass(frozen=True)
class SampledSteps:
    """Sampled steps: shortly before losses of the road, one per loss, and anywhere."""

    before_losses: tuple[DriveStep, ...]
    anywhere: tuple[DriveStep, ...]

    @property
    def all(self) -> tuple[DriveStep, ...]:
        """All steps in order, drive by drive."""
        return tuple(sorted(self.before_losses + self.anywhere))


def find_road_losses(rewards: Floats) -> list[int]:
    """The steps at which a drive lost the road, by its rewards `(T,)` alone.

    A loss begins after a positive reward if none of the next `LOSS_STEPS` rewards, or more, is positive.
    """
    paid = np.flatnonzero(rewards > 0)
    unpaid = np.diff(paid, append=len(rewards)) - 1
    return [int(step) + 1 for step in paid[unpaid >= LOSS_STEPS]]


def on_road_mask(reward: Floats) -> NDArray[np.bool_]:
    """Which steps of a drive `(T,)` have a positive reward within the next `LOSS_STEPS` steps: it is on the road."""
    steps = np.arange(len(reward))
    paid = np.where(reward > 0, steps, 2 * len(reward) + LOSS_STEPS)
    following = np.minimum.accumulate(paid[::-1])[::-1]
    return np.asarray(following - steps < LOSS_STEPS)


def sample_steps(drives: Sequence[Floats], count: int, random: np.random.Generator) -> SampledSteps:
    """Sample `count` steps of drives with rewards `(T,)`, up to half of them before losses.

    The others are uniform over all steps from `FIRST_START` on. There are fewer than `count` if the drives are short.
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
    """Sample `count` different steps uniformly over all drives, or take all if there are fewer."""
    lengths = np.array([max(len(rewards) - FIRST_START, 0) for rewards in drives])
    ends = np.cumsum(lengths)
    places = random.choice(ends[-1], size=min(count, int(ends[-1])), replace=False)
    chosen = np.searchsorted(ends, places, side="right")
    steps = FIRST_START + places - (ends - lengths)[chosen]
    return [DriveStep(int(drive), int(step)) for drive, step in zip(chosen, steps, strict=True)]
