"""The episode loop, which scoring, evaluating, recording, collecting and inspecting share. Pages: tasks.md."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.scoring.rollout import Rollout
from dreamfleet.worker.tasks.api import Policy, Score
from dreamfleet.worker.tasks.reset import reset_folded
from dreamfleet.worker.tasks.side_by_side import Policies

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


class OpenEpisode:
    """An episode under way. `observation` is the one that the next action answers; `over`: there is none."""

    def __init__(
        self, environment: gymnasium.Env[Any, Any], episode_config: EpisodeConfig, begin: ResetHook | None = None
    ) -> None:
        """Reset the environment; `begin` may change it right after that."""
        self.observation = reset_folded(environment, episode_config.seed)
        if begin is not None:
            self.observation = begin(environment, self.observation)
        self._environment = environment
        self._horizon, self._patience = episode_config.horizon, episode_config.patience
        self._steps = self._idle = 0
        self.over = self._horizon < 1

    def step(self, action: Any) -> Transition:
        """Take one step with an action.

        The episode is over when the environment ends it, after `horizon` steps, or after `patience` steps without a
        positive reward. `ValueError` if the environment fails at an action that is not finite because of what was seen.
        """
        seen = self.observation
        try:
            answer = self._environment.step(action)
        except Exception as error:
            if _is_finite(action) or _is_finite(seen):
                raise
            raise ValueError(
                "an observation holds NaN, infinity or a number beyond 3.4e38, which is infinite in the single "
                f"precision of controllers, and so the action is NaN: {type(error).__name__}"
            ) from error
        self.observation, given, terminated, truncated, info = answer
        reward = float(given)
        self._steps += 1
        self._idle = 0 if reward > 0 else self._idle + 1
        ended = bool(terminated or truncated)
        cut = not ended and 0 < self._patience <= self._idle
        self.over = ended or cut or self._steps >= self._horizon
        return Transition(seen, action, reward, self._steps, ended, cut, info, bool(terminated and not truncated))


def run_episode(
    environment: gymnasium.Env[Any, Any], policy: Policy, episode_config: EpisodeConfig, begin: ResetHook | None = None
) -> Iterator[Transition]:
    """Yield the steps of an episode (`OpenEpisode`); the caller has called `policy.begin`."""
    episode = OpenEpisode(environment, episode_config, begin)
    # Only a `RewardAwarePolicy` has it; `isinstance` with a protocol takes 70 microseconds, as long as some steps.
    report_reward: Callable[[float], None] | None = getattr(policy, "reward", None)
    while not episode.over:
        moment = episode.step(policy.act(episode.observation))
        if report_reward is not None:
            report_reward(moment.reward)
        yield moment


class _Tally:
    """What an episode has scored so far."""

    def __init__(self, episode_config: EpisodeConfig) -> None:
        self._config = episode_config
        self._fitness, self._steps, self._off_course_steps, self._finished = 0.0, 0, 0, False

    def add(self, moment: Transition) -> None:
        """Add a step."""
        config = self._config
        self._fitness += moment.reward
        self._steps = moment.step
        if moment.cut:
            self._fitness -= config.idle_cost * (config.horizon - moment.step)
        if config.off_course_cost:
            self._off_course_steps += bool(moment.info.get(config.off_course))
        self._finished = moment.ended and bool(moment.info.get(config.finish))

    def score(self) -> Score:
        """The score of the whole episode; `ValueError` if it is not a number."""
        fitness, config = self._fitness, self._config
        if config.time_cost:
            fitness -= config.time_cost * (self._steps if self._finished else config.horizon)
        fitness -= config.off_course_cost * min(self._off_course_steps, MAX_OFF_COURSE_STEPS)
        if not math.isfinite(fitness):
            raise ValueError("the episode's rewards do not add up to a number")
        return Score(fitness, self._steps)


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
    _check_finite(parameters)
    policy.begin(parameters)
    tally = _Tally(episode_config)
    for moment in run_episode(environment, policy, episode_config):
        tally.add(moment)
        if rollout is not None:
            rollout.add(moment.seen, moment.action, moment.reward)
            rollout.ended, rollout.terminal = moment.ended, moment.terminal
        if on_transition is not None:
            on_transition(moment)
        on_step(moment.step)
    return tally.score()


def score_side_by_side(
    environments: Sequence[gymnasium.Env[Any, Any]],
    policies: Policies,
    parameters: Sequence[NDArray[np.float32]],
    episode_configs: Sequence[EpisodeConfig],
    on_step: Callable[[int], None] = lambda _steps: None,
) -> list[Score]:
    """Run as many episodes side by side as there are `parameters`, each in an environment of its own.

    Each score is that of `score`, to the bit. `on_step` gets the number of steps so far, over all episodes.
    """
    for each in parameters:
        _check_finite(each)
    policies.begin(np.stack(parameters))
    together = zip(environments, episode_configs, strict=False)  # there may be more environments
    episodes = [OpenEpisode(environment, config) for environment, config in together]
    tallies = [_Tally(config) for config in episode_configs]
    open_ones = [number for number, each in enumerate(episodes) if not each.over]
    made = 0
    while open_ones:
        actions = policies.act(np.stack([episodes[number].observation for number in open_ones]))
        moments = [episodes[number].step(action) for number, action in zip(open_ones, actions, strict=True)]
        for number, moment in zip(open_ones, moments, strict=True):
            tallies[number].add(moment)
        policies.reward(np.array([moment.reward for moment in moments]))
        made += len(open_ones)
        on_step(made)
        rows = [row for row, number in enumerate(open_ones) if not episodes[number].over]
        if len(rows) < len(open_ones):
            policies.keep(rows)
            open_ones = [open_ones[row] for row in rows]
    return [each.score() for each in tallies]


def _is_finite(value: Any) -> bool:
    """Whether all numbers are finite in single precision; also of what is no array of numbers."""
    try:
        with np.errstate(over="ignore"):
            return bool(np.isfinite(np.asarray(value, np.float32)).all())
    except (TypeError, ValueError):
        return True


def _check_finite(parameters: NDArray[np.float32]) -> None:
    if not np.isfinite(parameters).all():
        raise ValueError("the controller's parameters hold NaN or infinity")
