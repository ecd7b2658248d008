"""Tasks whose episodes take a known time, to measure the overhead around them."""

import time
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.tasks.api import Assignment, Continuous, Task, World

SLEEP_SECONDS = 0.05
SLEEP_TASK, NULL_TASK, HALF_SECOND_TASK = (f"{__name__}:{name}" for name in ("SleepTask", "NullTask", "HalfSecondTask"))


class SleepEnvironment(gymnasium.Env[Any, Any]):
    """An environment of one step that takes `seconds`; the reward depends on the seed alone."""

    def __init__(self, seconds: float) -> None:
        self.observation_space = gymnasium.spaces.Box(-1, 1, (1,))
        self.action_space = gymnasium.spaces.Box(-1, 1, (1,))
        self._seconds = seconds
        self._seed = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:  # noqa: ARG002 - gymnasium's
        """Begin an episode."""
        super().reset(seed=seed)
        self._seed = seed or 0
        return np.zeros(1, np.float32), {}

    def step(self, _action: Any) -> Any:
        """Sleep, then end the episode."""
        if self._seconds:
            time.sleep(self._seconds)
        return np.zeros(1, np.float32), float(self._seed % 1000), True, False, {}


class IdlePolicy:
    """A policy that does nothing."""

    def begin(self, parameters: NDArray[np.float32]) -> None:
        """Begin an episode."""

    def act(self, observation: Any) -> Any:
        """Return the observation as an action that nothing reads."""
        return observation


class SleepTask(Task):
    """Episodes of 50 ms."""

    name = SLEEP_TASK
    world = World(actions=Continuous.between([-1.0], [1.0]))
    seconds = SLEEP_SECONDS

    def make_environment(self, _assignment: Assignment) -> gymnasium.Env[Any, Any]:
        """The environment that sleeps."""
        return SleepEnvironment(self.seconds)

    def make_policy(self, _assignment: Assignment) -> IdlePolicy:
        """The idle policy, whatever the bundle."""
        return IdlePolicy()


class NullTask(SleepTask):
    """Episodes that take no time."""

    name = NULL_TASK
    seconds = 0.0


class HalfSecondTask(SleepTask):
    """Episodes of half a second."""

    name = HALF_SECOND_TASK
    seconds = 0.5
