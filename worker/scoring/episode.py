"""The one episode loop: whoever scores, judges, records, collects or inspects goes through it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.scoring.rollout import Rollout
from dreamfleet.worker.tasks.api import Policy, Score

MAX_STRAYS = 100  # steps off the course that an episode pays for at most: one that is lost is one loss, however long


@dataclass(frozen=True)
class EpisodeConfig:
    """One episode: its seed, its steps at most, and when a hopeless one is cut (`patience` 0: never)."""

    seed: int
    horizon: int
    patience: int = 0
    idle_cost: float = 0.0  # the world's: charged for each step that is cut off
    time_cost: float = 0.0  # charged for each step until the course is finished, or the horizon
    finish: str = ""  # the world's
    stray_cost: float = 0.0  # charged for each step off the course, of the first `MAX_STRAYS`
    stray: str = ""  # the world's


class Transition(NamedTuple):
    """One step that was made."""

    seen: Any  # the observation before the action
    action: Any
    reward: float
    step: int  # from 1
    ended: bool  # the environment says so
    cut: bool  # patience is at its end
    info: dict[str, Any]  # what else the environment says
    terminal: bool = False  # it ended for good, and was not only cut short by the environment's own limit


ResetHook = Callable[[gymnasium.Env[Any, Any], Any], Any]
"""Changes an environment that was just reset, and its first observation; returns the new one."""


def run_episode(
    environment: gymnasium.Env[Any, Any], policy: Policy, episode_config: EpisodeConfig, begin: ResetHook | None = None
) -> Iterator[Transition]:
    """Make the episode's steps one by one, under a policy that has begun.

    It is over where the environment says so, after `horizon` steps, or after `patience` steps without a positive
    reward.
    """
    observation, _ = environment.reset(seed=episode_config.seed)
    if begin is not None:
        observation = begin(environment, observation)
    # Of a `RewardAwarePolicy`: `isinstance` of a protocol takes 70 microseconds, as long as some tasks' steps.
    report_reward: Callable[[float], None] | None = getattr(policy, "reward", None)
    idle, over = 0, False
    for step in range(1, episode_config.horizon + 1):
        seen, action = observation, policy.act(observation)
        observation, given, terminated, truncated, info = environment.step(action)
        reward = float(given)
        if report_reward is not None:
            report_reward(reward)
        idle = 0 if reward > 0 else idle + 1
        ended = bool(terminated or truncated)
        over = not ended and 0 < episode_config.patience <= idle
        yield Transition(seen, action, reward, step, ended, over, info, bool(terminated))
        if ended or over:
            return


def score(
    environment: gymnasium.Env[Any, Any],
    policy: Policy,
    parameters: NDArray[np.float32],
    episode_config: EpisodeConfig,
    on_step: Callable[[int], None] = lambda _steps: None,
    rollout: Rollout | None = None,
    on_transition: Callable[[Transition], None] | None = None,
) -> Score:
    """The episode's fitness: the sum of its rewards, in step order, in double precision.

    `rollout` records the episode, and `on_transition` gets each step.

    An episode that patience cuts is charged what standing still would have cost up to the horizon, so that cut and
    uncut candidates compare. Time costs up to the horizon too, unless the course is finished: to crash saves nothing.
    Steps off the course cost too: they foretell a loss long before one is seen in rewards.
    """
    if not np.isfinite(parameters).all():
        raise ValueError("the controller's parameters hold NaN or infinity")
    policy.begin(parameters)
    fitness, steps, strays, finished = 0.0, 0, 0, False
    for moment in run_episode(environment, policy, episode_config):
        fitness += moment.reward
        steps = moment.step
        if rollout is not None:
            rollout.add(moment.seen, moment.action, moment.reward)
            rollout.ended = moment.ended
        if on_transition is not None:
            on_transition(moment)
        on_step(steps)
        if moment.cut:
            fitness -= episode_config.idle_cost * (episode_config.horizon - steps)
        strays += bool(episode_config.stray_cost and moment.info.get(episode_config.stray))
        finished = moment.ended and bool(moment.info.get(episode_config.finish))
    if episode_config.time_cost:
        fitness -= episode_config.time_cost * (steps if finished else episode_config.horizon)
    fitness -= episode_config.stray_cost * min(strays, MAX_STRAYS)
    if not math.isfinite(fitness):
        raise ValueError("the episode's rewards do not add up to a number")
    return Score(fitness, steps)
