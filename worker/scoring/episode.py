"""The episode loop, blind to what the task is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.scoring.rollout import Drive
from dreamfleet.worker.tasks.api import Policy, Score

IDLE_COST = 0.1  # CarRacing's own cost of a step


@dataclass(frozen=True)
class Course:
    """One episode: its seed, its steps at most, and when a hopeless one is cut (`patience` 0: never)."""

    seed: int
    horizon: int
    patience: int = 0


def rollout(
    environment: gymnasium.Env[Any, Any],
    policy: Policy,
    parameters: NDArray[np.float32],
    course: Course,
    on_step: Callable[[int], None] = lambda _steps: None,
    drive: Drive | None = None,
) -> Score:
    """Drive one episode; the sum of its rewards, in step order, in double precision. `drive` keeps what happens.

    An episode cut after `patience` steps without a positive reward is charged what standing still would have cost up
    to the horizon, so that cut and uncut candidates compare.
    """
    if not np.isfinite(parameters).all():
        raise ValueError("the controller's parameters hold NaN or infinity")
    observation, _ = environment.reset(seed=course.seed)
    policy.begin(parameters)
    # Of a `Rewarded` policy; to ask `isinstance` of a protocol takes 70 microseconds, as long as some tasks' steps.
    tell: Callable[[float], None] | None = getattr(policy, "reward", None)
    fitness, idle, steps, ended = 0.0, 0, 0, False
    while steps < course.horizon and not ended:
        action, seen = policy.act(observation), observation
        observation, reward, terminated, truncated, _ = environment.step(action)
        if drive is not None:
            drive.add(seen, action, float(reward))
        fitness += float(reward)
        if tell is not None:
            tell(float(reward))
        steps += 1
        on_step(steps)
        ended = bool(terminated or truncated)
        idle = 0 if float(reward) > 0 else idle + 1
        if course.patience and idle >= course.patience and not ended:
            fitness -= IDLE_COST * (course.horizon - steps)
            break
    if drive is not None:
        drive.ended = ended
    if not math.isfinite(fitness):
        raise ValueError("the episode's rewards do not add up to a number")
    return Score(fitness, steps)
