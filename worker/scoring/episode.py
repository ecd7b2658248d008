"""The episode loop, which scoring, evaluating, recording, collecting and inspecting share."""

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
from dreamfleet.worker.tasks.reset import reset_folded

MAX_OFF_COURSE_STEPS = 100  # most steps off the course that are charged: a lost course is one loss, however long


@dataclass(frozen=True)
class EpisodeConfig:
    """Seed, limits and costs of an episode. The costs and keys are those of the same names in `World`."""

    seed: int
    horizon: int  # most steps
    patience: int = 0  # steps without a positive reward after which it is cut; 0: never
    idle_cost: float = 0.0
    time_cost: float = 0.0
    finish: str = ""
    off_course_cost: float = 0.0
    off_course: str = ""


class Transition(NamedTuple):
    """One step of an episode."""

    seen: Any  # the observation before the action
    action: Any
    reward: float
    step: int  # from 1
    ended: bool  # the environment terminated or truncated the episode
    cut: bool  # patience has run out
    info: dict[str, Any]  # the environment's
    terminal: bool = False  # the environment terminated the episode, and did not truncate it


ResetHook = Callable[[gymnasium.Env[Any, Any], Any], Any]
"""Changes an environment that was just reset; takes its first observation and returns the new one."""


def run_episode(
    environment: gymnasium.Env[Any, Any], policy: Policy, episode_config: EpisodeConfig, begin: ResetHook | None = None
) -> Iterator[Transition]:
    """Yield the steps of an episode; the caller has called `policy.begin`.

    The episode ends when the environment ends it, after `horizon` steps, or after `patience` steps without a positive
    reward. `begin` may change the environment right after its reset.
    """
    observation = reset_folded(environment, episode_config.seed)
    if begin is not None:
        observation = begin(environment, observation)
    # Only a `RewardAwarePolicy` has it; `isinstance` with a protocol takes 70 microseconds, as long as some steps.
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
        yield Transition(seen, action, reward, step, ended, over, info, bool(terminated and not truncated))
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
    """Run an episode; the fitness is the sum of its rewards in step order, in double precision, minus the costs.

    `rollout` records the episode, and `on_transition` gets each step. An episode that patience cuts is charged what
    standing still up to the horizon costs, so that cut and uncut candidates are comparable. `time_cost` is charged up
    to the horizon unless the course is finished, so that a crash saves nothing. Steps off the course are charged
    because they announce a loss long before rewards do.
    """
    if not np.isfinite(parameters).all():
        raise ValueError("the controller's parameters hold NaN or infinity")
    policy.begin(parameters)
    fitness, steps, off_course_steps, finished = 0.0, 0, 0, False
    for moment in run_episode(environment, policy, episode_config):
        fitness += moment.reward
        steps = moment.step
        if rollout is not None:
            rollout.add(moment.seen, moment.action, moment.reward)
            rollout.ended, rollout.terminal = moment.ended, moment.terminal
        if on_transition is not None:
            on_transition(moment)
        on_step(steps)
        if moment.cut:
            fitness -= episode_config.idle_cost * (episode_config.horizon - steps)
        off_course_steps += bool(episode_config.off_course_cost and moment.info.get(episode_config.off_course))
        finished = moment.ended and bool(moment.info.get(episode_config.finish))
    if episode_config.time_cost:
        fitness -= episode_config.time_cost * (steps if finished else episode_config.horizon)
    fitness -= episode_config.off_course_cost * min(off_course_steps, MAX_OFF_COURSE_STEPS)
    if not math.isfinite(fitness):
        raise ValueError("the episode's rewards do not add up to a number")
    return Score(fitness, steps)
