"""Whole episodes in the environment that reported scores come from, and how they were driven."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import fmean

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.bundle import Bundle
from dreamfleet.common.evaluated import Drive
from dreamfleet.common.messages import TaskSpec
from dreamfleet.worker.scoring.episode import Moment
from dreamfleet.worker.scoring.scorer import Scorer
from dreamfleet.worker.tasks.api import Score, World

SPEED, BRAKE = "speed", "brake"  # of a world's truth, and of its actions


class Judge:
    """Drives controllers in their task's judge, one episode after the other."""

    def __init__(self, spec: TaskSpec, bundle: Bundle | None = None) -> None:
        self._scorer = Scorer(spec, bundle, judge=True)

    def drive(self, parameters: NDArray[np.float32], seed: int) -> Drive:
        """One whole episode; the truth is only looked at, so that a score is the same whoever looks."""
        watch = Watch(self._scorer.world, self._scorer.truth)
        return watch.drive(seed, self._scorer.judge(parameters, seed, watch.see))

    def close(self) -> None:
        """Release the environment."""
        self._scorer.close()


class Watch:
    """Notes how one episode is driven, as far as its world lets it know."""

    def __init__(self, world: World, truth: Callable[[], dict[str, float]] | None) -> None:
        self._truth, self._finish = truth, world.finish
        named = truth is not None and BRAKE in world.action_names
        self._brake = world.action_names.index(BRAKE) if named else None
        self._speeds: list[float] = []
        self._braked: list[bool] = []
        self._finished = False

    def see(self, moment: Moment) -> None:
        """One step that was made."""
        self._finished = bool(moment.info.get(self._finish, False))
        told = self._truth() if self._truth is not None else {}
        if SPEED in told:
            self._speeds.append(told[SPEED])
        if self._brake is not None:
            self._braked.append(bool(moment.action[self._brake] > 0))

    def drive(self, seed: int, score: Score) -> Drive:
        """The whole of it."""
        finished = self._finished if self._finish else None
        return Drive(seed, score.fitness, score.steps, finished, _mean(self._speeds), _mean(self._braked))


def _mean(values: Sequence[float]) -> float | None:
    return fmean(values) if values else None
