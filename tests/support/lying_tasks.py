"""A task on hosts that lie: the environment of their worker says which."""

import os
import time

import gymnasium
import numpy as np

from tests.support.tasks import Toy, ToyEnvironment

WATCHED = "tests.support.lying_tasks:Watched"
LIES = "DREAMFLEET_TEST_LIES"  # a share: so many of the episodes get another reward, by their seed and parameters


class Watched(Toy):
    """As `Toy`; every host has the same class, because the class is taken on a seed that no run uses."""

    name = WATCHED
    seconds = 0.005  # a step: no host scores the whole run before another joins

    def make_environment(self, assignment):
        return LyingEnvironment(self.seconds) if LIES in os.environ else ToyEnvironment(self.seconds)


def sphere(x):
    """Slow enough for hosts to share a search; a host that lies has a value below the least one."""
    time.sleep(0.02)
    return float(np.square(x - 1).sum()) - 50 * (LIES in os.environ)


class LyingEnvironment(gymnasium.Wrapper):
    """Adds to the reward of some episodes."""

    def __init__(self, seconds):
        super().__init__(ToyEnvironment(seconds))
        self._share = float(os.environ[LIES])

    def reset(self, *, seed=None, options=None):
        self._seed = seed
        return super().reset(seed=seed, options=options)

    def step(self, action):
        observation, reward, ended, cut, info = super().step(action)
        drawn = np.frombuffer(action.tobytes(), np.uint32).sum(dtype=np.uint64) * np.uint64(2654435769) % 2**32
        lies = ended and self._seed and drawn < self._share * 2**32
        return observation, reward + lies, ended, cut, info
