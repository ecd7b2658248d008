"""Steps of recorded drives: losses of the course, or deaths, and beginnings of dreams for a bundle."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
FIRST_START = 20  # first step of a drive at which a dream may begin; before it the recurrent state is almost empty
LOSS_STEPS = 40  # the first world's `lost_after`
EARLIEST, LATEST = 60, 5  # bounds of the steps before a loss at which a dream may begin (docs/explanation/dreams.md)


class DriveStep(NamedTuple):
    """A step of a drive, before its action; drives are numbered in their given order."""

    drive: int
    step: int


@dataclass(frozen=True)
class SampledSteps:
    """Sampled steps: shortly before losses of the course, one per loss, and anywhere."""

    before_losses: tuple[DriveStep, ...]
    anywhere: tuple[DriveStep, ...]

    @property
    def all(self) -> tuple[DriveStep, ...]:
        """All steps in order, drive by drive."""
        return tuple(sorted(self.before_losses + self.anywhere))


def find_road_losses(rewards: Floats, lost_after: int = LOSS_STEPS, terminal: bool = False) -> list[int]:
    """The steps at which a drive with rewards `(T,)` lost the course; `lost_after` is its world's.

    A loss begins after a positive reward if none of the next `lost_after` rewards, or more, is positive. If
    `lost_after` is 0, a loss is the last step of a drive that is `terminal`: that ended with a death.
    """
    if not lost_after:
        return [len(rewards) - 1] if terminal else []
    paid = np.flatnonzero(rewards > 0)
    unpaid = np.diff(paid, append=len(rewards)) - 1
    return [int(step) + 1 for step in paid[unpaid >= lost_after]]


def on_road_mask(reward: Floats, lost_after: int = LOSS_STEPS) -> NDArray[np.bool_]:
    """Which steps of a drive `(T,)` have a positive reward within the next `lost_after` steps: it is on the course.

    If `lost_after` is 0, all do.
    """
    if not lost_after:
        return np.ones(len(reward), np.bool_)
    steps = np.arange(len(reward))
    paid = np.where(reward > 0, steps, 2 * len(reward) + lost_after)
    following = np.minimum.accumulate(paid[::-1])[::-1]
    return np.asarray(following - steps < lost_after)


def sample_steps(
    drives: Sequence[Floats], count: int, random: np.random.Generator, lost_after: int = LOSS_STEPS,
    terminal: Sequence[bool] = (),
) -> SampledSteps:  # fmt: skip
    """Sample `count` steps of drives with rewards `(T,)`, up to half of them before losses.

    `lost_after` and each drive's `terminal`, empty for none, are those of `find_road_losses`. The others are uniform
    over all steps from `FIRST_START` on, or from half a drive's median length where most drives are not longer than
    that. There are fewer than `count` if the drives are short.
    """
    median = int(np.median([len(rewards) for rewards in drives]))
    first = FIRST_START if median > FIRST_START else median // 2
    deaths = terminal or [False] * len(drives)
    lost = [
        DriveStep(drive, step)
        for drive, (rewards, dead) in enumerate(zip(drives, deaths, strict=True))
        for step in find_road_losses(rewards, lost_after, bool(dead))
    ]
    lost = [each for each in lost if each.step - LATEST >= first]
    chosen = [lost[index] for index in random.permutation(len(lost))[: count // 2]]
    before = {
        DriveStep(drive, int(random.integers(max(first, step - EARLIEST), step - LATEST, endpoint=True)))
        for drive, step in chosen
    }
    anywhere = [each for each in _anywhere(drives, count, first, random) if each not in before]
    return SampledSteps(tuple(sorted(before)), tuple(anywhere[: count - len(before)]))


def _anywhere(drives: Sequence[Floats], count: int, first: int, random: np.random.Generator) -> list[DriveStep]:
    """Sample `count` different steps uniformly over all drives, or take all if there are fewer."""
    lengths = np.array([max(len(rewards) - first, 0) for rewards in drives])
    ends = np.cumsum(lengths)
    places = random.choice(ends[-1], size=min(count, int(ends[-1])), replace=False)
    chosen = np.searchsorted(ends, places, side="right")
    steps = first + places - (ends - lengths)[chosen]
    return [DriveStep(int(drive), int(step)) for drive, step in zip(chosen, steps, strict=True)]
